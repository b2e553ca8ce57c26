# shellcheck shell=bash
# SPDX-License-Identifier: MIT
# Sourced by deploy/run: system packages, virtual environment, Python packages.
# Required: Python 3.11 with venv, a C++ compiler. Everything else is wished for and may be absent.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv

say() { printf 'deploy/run: %s\n' "$*" >&2; }

stop() {
    local code=$1
    shift
    say "$@"
    exit "$code"
}

# --- what the machine has -------------------------------------------------------------------------------------------

have() { command -v "$1" >/dev/null 2>&1; }

python_runs() { "${PYTHON:-python3}" -c "$1" >/dev/null 2>&1; }

have_python() { python_runs 'import sys; sys.exit(sys.version_info < (3, 11))'; }
have_venv() { python_runs 'import ensurepip, venv'; }
have_python_headers() {
    python_runs 'import os, sysconfig as s; os.stat(os.path.join(s.get_path("include"), "Python.h"))'
}
have_compiler() { have "${CXX:-g++}" || have g++ || have clang++; }  # what sim_server/backend.py looks for
have_suitesparse() { [ -n "${SUITESPARSE_INCLUDE_DIR:-}" ] || [ -e /usr/include/suitesparse/cholmod.h ]; }
have_openblas() { compgen -G '/usr/lib/*/libopenblas.so.0' >/dev/null || ! have apt-get; }
have_software_vulkan() { compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' >/dev/null; }

# missing_packages [mesa-vulkan-drivers]: names of the Debian packages for what is not there.
missing_packages() {
    if [ -z "${PYTHON:-}" ]; then  # another interpreter brings its own
        have_python || echo python3
        have_venv || echo python3-venv
        have_python_headers || echo python3-dev
    fi
    have_compiler || echo g++
    # CHOLMOD, and OpenBLAS for it: on the reference BLAS a factorization takes 4 to 10 times as long.
    have_suitesparse || echo libsuitesparse-dev
    have_openblas || echo libopenblas-dev
    if [ "${1:-}" = mesa-vulkan-drivers ]; then
        have_software_vulkan || echo mesa-vulkan-drivers  # draws the demonstration's picture without a GPU or a screen
    fi
}

# --- system packages ------------------------------------------------------------------------------------------------

as_root() {
    if [ "$(id -u)" -eq 0 ]; then "$@"; else sudo "$@"; fi
}

# Asks for a password only where somebody can type one.
may_be_root() {
    [ "$(id -u)" -eq 0 ] && return
    have sudo || return
    sudo -n true 2>/dev/null || [ -t 0 ]
}

apt_get() {
    as_root env DEBIAN_FRONTEND=noninteractive NEEDRESTART_SUSPEND=1 \
        apt-get -qq -y -o Dpkg::Use-Pty=0 -o DPkg::Lock::Timeout=300 "$@"
}

install_system_packages() {
    local missing=() words log
    mapfile -t missing < <(missing_packages "$@")
    [ ${#missing[@]} -gt 0 ] || return 0
    words="apt-get install --no-install-recommends ${missing[*]}"
    if ! have apt-get; then
        say "this is not Debian or Ubuntu; wanted, under its Debian names: ${missing[*]}"
    elif may_be_root; then
        say "installing system packages, a minute or so: ${missing[*]}"
        log=$(mktemp)
        if ! { apt_get update && apt_get install --no-install-recommends "${missing[@]}"; } >"$log" 2>&1; then
            tail -n 20 "$log" >&2
            say "this failed; going on without: $words"
        fi
        rm -f "$log"
    else
        say "packages are missing, and this user is neither root nor may use sudo. An administrator may run: $words"
    fi
}

require_essentials() {
    have_python || stop 2 "Python 3.11 or later is needed (Debian: python3); PYTHON=... names another than python3"
    have_venv || stop 2 "Python's venv module is needed (Debian: python3-venv)"
    have_compiler || stop 2 "a C++ compiler is needed: kernels are compiled at run time (Debian: g++)"
}

# Debian chooses OpenBLAS by itself unless somebody once set the alternative by hand.
check_blas() {
    local name
    have update-alternatives || return 0
    for name in $(update-alternatives --get-selections | awk '/^lib(blas|lapack)\.so\.3-/ { print $1 }'); do
        case $(update-alternatives --query "$name" | sed -n 's/^Value: //p') in
            */blas/* | */lapack/*) ;;
            *) continue ;;
        esac
        [ "$(id -u)" -eq 0 ] && update-alternatives --quiet --auto "$name" && continue
        say "$name is the slow reference library; better: sudo update-alternatives --auto $name"
    done
}

# --- Python packages ------------------------------------------------------------------------------------------------

have_sksparse() { compgen -G "$venv/lib/python3*/site-packages/sksparse/cholmod*.so" >/dev/null; }

# A driver from 580 on serves CUDA 13.
have_gpu() {
    local driver
    driver=$(nvidia-smi --query-gpu=driver_version --format=csv,noheader 2>/dev/null | head -n 1) || return 1
    [ "${driver%%.*}" -ge 580 ] 2>/dev/null
}

# Changes whenever an installed environment may no longer fit. The path counts since scripts in .venv/bin hold it.
fingerprint() {
    {
        echo "$root" "$1"
        "${PYTHON:-python3}" -c 'import sys; print(sys.version, sys.base_prefix)'
        have_suitesparse && have_python_headers && echo cholmod
        cat "$root/pyproject.toml" "$root/deploy/constraints.txt" "$root/deploy/setup.sh"
    } | sha256sum
}

pip_install() {
    # PIP_USER: a user = true in somebody's pip.conf would contradict the virtual environment.
    PIP_USER=0 "$venv/bin/python" -m pip --disable-pip-version-check install -q -c "$root/deploy/constraints.txt" "$@" \
        >>"$venv/setup.log" 2>&1
}

make_venv() {
    local wanted present
    wanted=$("${PYTHON:-python3}" -c 'import sys; print(sys.version_info[:2])')
    present=$("$venv/bin/python" -m pip --version >/dev/null 2>&1 &&
        "$venv/bin/python" -c 'import sys; print(sys.version_info[:2])') || present=none
    [ "$present" != "$wanted" ] || return 0
    say "making the virtual environment $venv"
    "${PYTHON:-python3}" -m venv --clear "$venv" || stop 1 "cannot make $venv"
}

install_cholmod() {
    have_suitesparse && have_python_headers || return 0
    have_sksparse && return
    say "building scikit-sparse (CHOLMOD), about half a minute"
    # Not isolated: built with the setuptools, Cython and NumPy of constraints.txt, today and in a year.
    { pip_install setuptools cython && pip_install --no-build-isolation scikit-sparse; } ||
        say "scikit-sparse could not be built; $venv/setup.log says why"
}

install_python_packages() {
    local extras=$1 stamp now
    have_gpu && extras=$extras,gpu
    stamp=$venv/setup-$extras.sha256
    now=$(fingerprint "$extras")
    if [ "$(cat "$stamp" 2>/dev/null)" != "$now" ] || ! [ -x "$venv/bin/python" ]; then
        make_venv
        say "installing Python packages, a minute or two; log in $venv/setup.log"
        : >"$venv/setup.log"
        if ! pip_install -e "${root}[$extras]"; then
            tail -n 20 "$venv/setup.log" >&2
            stop 1 "pip failed; $venv/setup.log has all of it"
        fi
        install_cholmod
        printf '%s\n' "$now" >"$stamp"
    fi
    have_sksparse || say "without scikit-sparse: factors come from SciPy's SuperLU, right but slower to make"
}

# set_up EXTRAS [mesa-vulkan-drivers]
set_up() {
    local extras=$1
    shift
    if have flock; then
        exec 9<"$root/deploy"  # two calls at once: the second waits, then finds everything done
        flock 9
    fi
    install_system_packages "$@"
    require_essentials
    check_blas
    install_python_packages "$extras"
    if have flock; then
        exec 9<&-
    fi
}

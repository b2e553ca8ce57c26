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

# --- commands that take their time -----------------------------------------------------------------------------------

EVERY=20  # s between lines that say how far a command is, where nobody sits at a terminal

# newest LOG: its last line, shortened.
newest() { tail -c 2000 "$1" 2>/dev/null | tr '\r' '\n' | grep -v '^[[:space:]]*$' | tail -n 1 | cut -c 1-70; }

# tell_progress WHAT LOG: until it is killed, or this script is gone, shows the time and what LOG says: on a terminal in one
# line that is written over again and again.
tell_progress() {
    local begun=$SECONDS told=$SECONDS line text
    while sleep 1 && kill -0 $$ 2>/dev/null; do
        line=$(newest "$2") || line=
        if [ -t 2 ]; then
            text="deploy/run: $1, $((SECONDS - begun)) s${line:+: $line}"
            printf '\r\033[K%s' "${text:0:${COLUMNS:-80}-1}" >&2
        elif ((SECONDS - told >= EVERY)); then
            told=$SECONDS
            say "still $1, $((SECONDS - begun)) s${line:+: $line}"
        fi
    done
}

# shown WHAT LOG COMMAND...: runs a command with its output at the end of LOG, and says meanwhile how far it is, at last how
# long it took.
shown() {
    local what=$1 log=$2 begun=$SECONDS code=0 teller
    shift 2
    [ -t 2 ] || say "$what"
    tell_progress "$what" "$log" 9<&- &  # without the lock of set_up
    teller=$!
    "$@" >>"$log" 2>&1 || code=$?
    kill "$teller" 2>/dev/null || true
    wait "$teller" 2>/dev/null || true
    [ ! -t 2 ] || printf '\r\033[K' >&2
    [ $code -ne 0 ] || say "$what: done in $((SECONDS - begun)) s"
    return $code
}

# --- what the machine has -------------------------------------------------------------------------------------------

have() { command -v "$1" >/dev/null 2>&1; }

python_runs() { "${PYTHON:-python3}" -c "$1" >/dev/null 2>&1; }

have_python() { python_runs 'import sys; sys.exit(sys.version_info < (3, 11))'; }
have_venv() { python_runs 'import ensurepip, venv'; }
have_python_headers() {
    python_runs 'import os, sysconfig as s; os.stat(os.path.join(s.get_path("include"), "Python.h"))'
}
have_compiler() { have "${CXX:-g++}" || have g++ || have clang++; }  # what sim_server/backends/compiler.py looks for
have_suitesparse() { [ -n "${SUITESPARSE_INCLUDE_DIR:-}" ] || [ -e /usr/include/suitesparse/cholmod.h ]; }
have_openblas() { compgen -G '/usr/lib/*/libopenblas.so.0' >/dev/null || ! have apt-get; }
have_chromium() { have chromium || have chromium-browser || have google-chrome; }
is_debian() { grep -qx 'ID=debian' /etc/os-release 2>/dev/null; }  # Ubuntu has chromium as a snap only
have_software_vulkan() { compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' >/dev/null; }

# missing_packages [mesa-vulkan-drivers] [chromium] [cholmod]: names of the Debian packages for what is not there.
missing_packages() {
    if [ -z "${PYTHON:-}" ]; then  # another interpreter brings its own
        have_python || echo python3
        have_venv || echo python3-venv
        [[ " $* " != *" cholmod "* ]] || have_python_headers || echo python3-dev
    fi
    have_compiler || echo g++
    if [[ " $* " == *" cholmod "* ]]; then  # tests and benches compare with it
        have_suitesparse || echo libsuitesparse-dev
        have_openblas || echo libopenblas-dev  # on the reference BLAS a factorization takes 4 to 10 times as long
    fi
    case " $* " in
        # draws the demonstration's picture without a GPU or a screen
        *" mesa-vulkan-drivers "*) have_software_vulkan || echo mesa-vulkan-drivers ;;
    esac
    case " $* " in
        *" chromium "*) have_chromium || ! is_debian || echo chromium ;;  # tests and benches open the page in it
    esac
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
        apt-get -q -y -o Dpkg::Use-Pty=0 -o DPkg::Lock::Timeout=300 "$@"
}

# Asks who sits at a terminal; CI and scripts have said yes by running this.
may_install() {
    local answer=
    { [ -t 0 ] && [ -t 2 ] && [ -z "${CI:-}" ]; } || return 0
    printf 'deploy/run: install them (apt-get)? [Y/n] ' >&2
    read -r answer || true
    [[ "$answer" =~ ^([yY].*)?$ ]]
}

install_system_packages() {
    local missing=() words log
    mapfile -t missing < <(missing_packages "$@")
    [ ${#missing[@]} -gt 0 ] || return 0
    words="apt-get install --no-install-recommends ${missing[*]}"
    if ! have apt-get; then
        say "this is not Debian or Ubuntu; wanted, under its Debian names: ${missing[*]}"
    elif may_be_root; then
        say "needs system packages, for the whole machine: ${missing[*]}"
        may_install || { say "nothing is installed; going on without: $words"; return 0; }
        log=$(mktemp)
        [ "$(id -u)" -eq 0 ] || sudo -v || true  # asks for a password here, where nothing is written over it
        if ! { shown "reading lists of packages (apt-get)" "$log" apt_get update &&
            shown "installing system packages (apt-get)" "$log" \
                apt_get install --no-install-recommends "${missing[@]}"; }; then
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

# Debian chooses OpenBLAS by itself unless somebody once set the alternative by hand. It is the whole machine's: who set it
# may change it.
check_blas() {
    local name
    have update-alternatives || return 0
    for name in $(update-alternatives --get-selections | awk '/^lib(blas|lapack)\.so\.3-/ { print $1 }'); do
        case $(update-alternatives --query "$name" | sed -n 's/^Value: //p') in
            */blas/* | */lapack/*) ;;
            *) continue ;;
        esac
        say "$name is the slow reference library here; CHOLMOD takes a quarter of the time with OpenBLAS," \
            "which this chooses for the whole machine: sudo update-alternatives --auto $name"
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
        cat "$root/pyproject.toml" "$root"/deploy/{constraints.txt,locked.py,setup.sh}
    } | sha256sum
}

# Nothing is resolved, and nothing is built in an environment that pip would fill with what it finds newest.
pip_install() {
    # PIP_USER: a user = true in somebody's pip.conf would contradict the virtual environment.
    PIP_USER=0 PIP_ROOT_USER_ACTION=ignore "$venv/bin/python" -m pip --disable-pip-version-check --no-color \
        install --progress-bar off --no-deps --no-build-isolation "$@"
}

# install_locked EXTRA...: what these extras need, in the versions and with the hashes of constraints.txt.
install_locked() {
    local list code=0
    list=$(mktemp)
    "$venv/bin/python" "$root/deploy/locked.py" "$@" >"$list" && pip_install --require-hashes -r "$list" || code=$?
    rm -f "$list"
    return $code
}

# install_extras EXTRA,...: the same, and the project itself, to be edited.
install_extras() {
    # shellcheck disable=SC2086  # names of extras
    install_locked build && install_locked ${1//,/ } && pip_install --no-index -e "$root"
}

make_venv() {
    local wanted present log
    wanted=$("${PYTHON:-python3}" -c 'import sys; print(sys.version_info[:2])')
    present=$("$venv/bin/python" -m pip --version >/dev/null 2>&1 &&
        "$venv/bin/python" -c 'import sys; print(sys.version_info[:2])') || present=none
    [ "$present" != "$wanted" ] || return 0
    log=$(mktemp)
    shown "making the virtual environment .venv" "$log" "${PYTHON:-python3}" -m venv --clear "$venv" ||
        { cat "$log" >&2; stop 1 "cannot make $venv"; }
    rm -f "$log"
}

install_cholmod() {
    have_suitesparse && have_python_headers || return 0
    have_sksparse && return
    shown "building scikit-sparse, for CHOLMOD (pip)" "$venv/setup.log" install_locked cholmod ||
        say "scikit-sparse could not be built; $venv/setup.log says why"
}

install_python_packages() {
    local extras=server,mesh,$1 stamp now
    have_gpu && extras=$extras,gpu
    stamp=$venv/setup-$extras.sha256
    now=$(fingerprint "$extras")
    if [ "$(cat "$stamp" 2>/dev/null)" != "$now" ] || ! [ -x "$venv/bin/python" ]; then
        make_venv
        : >"$venv/setup.log"
        if ! shown "installing Python packages (pip)" "$venv/setup.log" install_extras "$extras"; then
            tail -n 20 "$venv/setup.log" >&2
            stop 1 "pip failed; $venv/setup.log has all of it"
        fi
        [[ ",$extras," != *",test,"* ]] || install_cholmod
        printf '%s\n' "$now" >"$stamp"
    fi
}

# set_up EXTRAS [mesa-vulkan-drivers] [chromium] [cholmod]
set_up() {
    local extras=$1
    shift
    if have flock; then
        exec 9<"$root/deploy"  # two calls at once: the second waits, then finds everything done
        flock 9
    fi
    install_system_packages "$@"
    require_essentials
    [[ " $* " != *" cholmod "* ]] || check_blas
    install_python_packages "$extras"
    if have flock; then
        exec 9<&-
    fi
}

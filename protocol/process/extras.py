# SPDX-License-Identifier: MIT
"""The commands that install the optional parts of this package, which is on no index, and what needs which of them."""

import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

CHECKOUT = Path(__file__).parents[2]
EXTRAS = {  # modules of each extra of pyproject.toml; a module of several stands at the smaller one
    "mesh": ("meshio", "pytetwild"),
    "server": ("loky", "mcap_protobuf", "pydantic", "pydantic_core", "pymetis", "scipy"),
    "gpu": ("cupy", "cupyx"),
    "view": ("matplotlib", "mpl_toolkits", "PIL", "plotly", "rerun"),
    "web": ("viser", "websockets"),
    "export": ("foxglove", "h5py", "imageio_ffmpeg", "pxr"),
    "gym": ("gymnasium",),
    "identify": ("optuna",),
    "tls": ("cryptography",),
    "slurm": ("submitit",),
    "metrics": ("prometheus_client",),
}


def to_install(extra: str) -> str:
    """Returns the command that installs an extra of pyproject.toml ("cholmod", "gpu", "view") for this Python."""
    checkout = (CHECKOUT / "pyproject.toml").is_file()
    wanted = ["-e", f"{CHECKOUT}[{extra}]"] if checkout else _requirements(extra)
    return shlex.join([sys.executable, "-m", "pip", "install", *wanted])


def missing_extra(error: BaseException) -> str:
    """Says which extra an import that failed is of, and what installs it; empty for any other error."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return ""
    module = error.name.partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if module in modules), "")
    return f"this needs the package {module}, of the extra {extra}: {to_install(extra)}" if extra else ""


def _requirements(extra: str) -> list[str]:
    """Returns the packages of an extra according to the installed package."""
    try:
        listed = requires("warpfactor") or []
    except PackageNotFoundError:
        return []
    found = (line.split(";") for line in listed)
    return [name.strip() for name, *condition in found if f'extra == "{extra}"' in "".join(condition).replace("'", '"')]

"""What the machine, the installation and the command line lack."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state

# packages

_BY_LOADING = {"detail": "libGL.so.1: cannot open shared object file"}
_INSTALLED = {"code": "install-on-debian", "values": {"package": "libgl1"}}


@message(example={"package": "open3d"})
def install_again(package: str) -> str:
    return f"pip install --force-reinstall {package}"


@message(example={"package": "libgl1"})
def install_on_debian(package: str) -> str:
    return f"on Debian: apt install {package}"


@message(advice=lambda mend, **_: str(mend), example={"package": "open3d", **_BY_LOADING, "mend": _INSTALLED})
def package_not_loaded(package: str, detail: str, mend: Said) -> str:
    return f"{package} cannot be loaded ({detail})"


@message(
    advice=lambda mend, **_: f"{mend}, or take --dense-options.mesh poisson",
    example={**_BY_LOADING, "mend": _INSTALLED},
)
def open3d_not_loaded(detail: str, mend: Said) -> str:
    return f"open3d cannot be loaded ({detail})"


@message(
    advice="install that package, or colmap-inertial again with its dependencies",
    joint=": ",
    example={"detail": "No module named 'yaml'"},
)
def module_missing(detail: str) -> str:
    return detail


@message(
    advice=lambda packages, **_: "pip install " + " ".join(f"'{package}'" for package in packages),
    joint=": ",
    example={
        "what": {"code": "needs-onnxruntime", "values": {}},
        "extra": "restore",
        "packages": ("onnxruntime>=1.20",),
    },
)
def extra_missing(what: Said, extra: str, packages: Sequence[str]) -> str:
    return f"{what}, which needs the extra `{extra}`"


state("needs-onnxruntime", "networks run in onnxruntime")
state("needs-open3d", "dense_options.mesh tsdf is made by open3d")

# memory and files

state(
    "memory-used-up",
    "the memory is used up",
    advice="close other programs, or allow smaller pictures or fewer processes",
    joint=": ",
)
state(
    "too-many-files-open",
    "too many files are open at a time",
    advice="raise the limit (ulimit -n) and start again",
    joint=": ",
)

"""What the machine, the installation and the command line lack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.shared import say_not_loaded

# packages

_BY_LOADING = {"detail": "libGL.so.1: cannot open shared object file"}
_INSTALLED = {"code": "install-on-debian", "values": {"package": "libgl1"}}


@message(example={"package": "open3d"})
def install_again(package: str) -> str:
    return f"pip install --force-reinstall {package}"


@message(example={"package": "libgl1"})
def install_on_debian(package: str) -> str:
    return f"on Debian: apt install {package}"


@message(
    advice=lambda installed, keep, **_: f"keep one of them: pip uninstall {' '.join(installed)}; pip install {keep}",
    example={
        "module": "pycolmap",
        "installed": {"pycolmap": "4.0.0", "pycolmap-cuda12": "4.1.0"},
        "keep": "pycolmap-cuda12",
    },
)
def packages_of_one_module(module: str, installed: Mapping[str, str], keep: str) -> str:
    named = " and ".join(f"{name} {version}" for name, version in installed.items())
    return (
        f"{named} are installed, and each provides the module {module}: the files of the last one overwrote the others'"
    )


@message(advice=lambda mend, **_: str(mend), example={"package": "open3d", **_BY_LOADING, "mend": _INSTALLED})
def package_not_loaded(package: str, detail: str, mend: Said) -> str:
    return say_not_loaded(package, detail)


@message(
    advice=lambda mend, **_: f"{mend}, or take --dense-options.mesh poisson",
    example={**_BY_LOADING, "mend": _INSTALLED},
)
def open3d_not_loaded(detail: str, mend: Said) -> str:
    return say_not_loaded("open3d", detail)


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
    return f"{what}; install the extra `{extra}`"


state("needs-onnxruntime", "networks need onnxruntime")
state("needs-open3d", "dense_options.mesh tsdf needs open3d")

# memory and files

state(
    "memory-used-up",
    "out of memory",
    advice="close other programs, or allow smaller images or fewer processes",
    joint=": ",
)
state(
    "too-many-files-open",
    "too many files are open at a time",
    advice="raise the limit (ulimit -n) and start again",
    joint=": ",
)


@message(
    advice=lambda needed_bytes, **_: f"raise the limit (ulimit -v {needed_bytes >> 10})",
    joint=": ",
    example={"allowed_bytes": 1000000000, "needed_bytes": 2500000000},
)
def too_little_memory_allowed(allowed_bytes: int, needed_bytes: int) -> str:
    return (
        f"only {allowed_bytes / 1e9:.2g} GB of memory are allowed to a process here, and {needed_bytes / 1e9:.2g} "
        "GB are needed"
    )


@message(
    advice=lambda needed, **_: f"raise the limit (ulimit -n {needed})",
    joint=": ",
    example={"allowed": 16, "needed": 64},
)
def too_few_files_allowed(allowed: int, needed: int) -> str:
    return f"only {allowed} files may be open at a time here, and {needed} are needed"


# tools

state("needs-pygltflib", "glTF files need pygltflib")

state("needs-laspy", "LAS files need laspy and pyproj")

state("needs-viser", "the viewer needs viser")

state(
    "viser-not-guarded",
    "this version of viser cannot be restricted to this machine's user",
    advice="install viser 1.1",
    joint=": ",
)


@message(example={"host": "localhost", "port": 8080, "detail": "Name or service not known"})
def port_unusable(host: str, port: int, detail: str) -> str:
    return f"cannot listen at {host}, port {port}: {detail}"


@message(advice="choose another with --port", example={"port": 8080, "host": "localhost"})
def no_port_free(port: int, host: str) -> str:
    return f"no port from {port} on is free at {host}"


# the report

state(
    "plotly-missing", "plotly, which draws the report, is not installed", advice="pip install 'plotly>=6'", joint=": "
)

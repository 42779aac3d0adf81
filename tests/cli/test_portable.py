"""The commands on a system that lacks what only Linux, or only POSIX, has."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

from colmap_inertial.run.steps.config import config_as_toml
from tests.helpers.batch_captures import TINY
from tests.run.commands.test_reconstruct import SCENE, copy_scene

#: Takes it away, then runs the commands of a JSON list and prints their exit codes.
ELSEWHERE = """
import json, os, signal, sys, warnings

for name in ("fcntl", "resource", "grp", "pwd", "termios"):
    sys.modules[name] = None
for name in (
    "posix_fadvise", "POSIX_FADV_SEQUENTIAL", "POSIX_FADV_DONTNEED", "copy_file_range", "sendfile", "sysconf",
    "sched_getaffinity", "sched_setaffinity", "process_cpu_count", "O_DIRECT", "O_DIRECTORY", "getuid", "killpg",
    "getpgid", "setsid", "getloadavg", "mkfifo",
):
    if hasattr(os, name):
        delattr(os, name)
del signal.SIGHUP, signal.SIGKILL
warnings.filterwarnings("ignore", "only soft file lock is available")

from colmap_inertial.tools.batch import shares_of_this_machine
from colmap_inertial.cli import main
from colmap_inertial.core.threads import usable_cores, usable_processors

codes = []
for args in json.loads(sys.argv[1]):
    try:
        main(args)
    except SystemExit as ended:
        codes.append(ended.code)
assert shares_of_this_machine(1, 1) == [usable_cores()]
print(json.dumps([usable_processors(), codes]))
"""


def test_commands_run_without_what_only_linux_has(project, tmp_path: Path) -> None:
    scene = copy_scene(tmp_path / "scene", first=9, half=False)  # its target is validated
    (tmp_path / "tiny.toml").write_text(config_as_toml(TINY))
    out, metric = tmp_path / "out", tmp_path / "metric"
    spec = tomllib.loads((SCENE / "capture.toml").read_text())["target"]["spec"]
    commands = [
        ["scale", project.model, "--imu", project.imu, "--frame-times", project.frame_times, "--json", "scale.json"],
        ["apply", project.model.parents[1], metric, "--scale", "scale.json"],
        ["reconstruct", scene, out, "--config", "tiny.toml"],
        ["validate", out / "sparse" / "0", "--images", out / "images", "--target", spec],
    ]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", ELSEWHERE, json.dumps([[str(word) for word in c] for c in commands])],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    processors, codes = json.loads(done.stdout.splitlines()[-1])
    assert (codes, processors >= 1) == ([0, 0, 0, 0], True), done.stderr
    assert (metric / "sparse" / "0" / "transform.json").is_file()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"scene", "tiny.toml", "scale.json", "out", "metric"}

"""What the documentation says is true: links lead somewhere, commands parse, files are read, examples run."""

import ast
import dataclasses
import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from jsonschema import Draft202012Validator

import colmap_inertial
from colmap_inertial.cli import GROUPS, main, parse
from colmap_inertial.colmap.dense.depth_maps import DenseResult
from colmap_inertial.core.errors import InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReconstructOptions
from colmap_inertial.core.types import Action, CameraModel, FrameTiming, Treatment
from colmap_inertial.imaging.gate import RecordingVerdict
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.selection import Chosen
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.capture_tables import ImuTables
from colmap_inertial.io.files import write_json
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.io.frames import read_frame_times
from colmap_inertial.io.imu import read_capture_imu
from colmap_inertial.io.imu_formats import imu_formats
from colmap_inertial.messages import all_messages, findings
from colmap_inertial.report import write_report
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.result import (
    Fragment,
    ModelResult,
    ReconstructResult,
    frame_as_json,
    imaging_as_json,
)
from colmap_inertial.run.preparation.selection import Selection
from colmap_inertial.run.stages.frame_folder import FrameRecord
from colmap_inertial.run.stages.imaging_plan import GyroView, ImagingPlan
from colmap_inertial.run.steps.config import config_as_toml
from colmap_inertial.tools.batch import read_manifest
from scripts.doc_examples import write_examples
from scripts.make_reference import pages
from tests.helpers import imu_files
from tests.helpers.batch_captures import FRAMES, TINY, tiny_capture
from tests.helpers.desk_scene import copy_scene
from tests.helpers.json_schemas import find_violations, read_schema
from tests.helpers.report_runs import write_run

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "example_scenes" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]
DEVELOPERS = [page for page in PAGES if page.is_relative_to(DOCS / "dev")]
#: Each generated page and its text; to make them takes half a second.
GENERATED = pages()
TEXT = "\n".join(page.read_text() for page in PAGES if page not in GENERATED)
_FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of one language."""
    return [textwrap.dedent(body) for _, kind, body in _FENCE.findall(page.read_text()) if kind == language]


def every(language: str) -> list[tuple[str, str]]:
    """Those of all pages, each with its page and number."""
    return [
        (f"{page.relative_to(ROOT)} {language} block {number}", body)
        for page in PAGES
        for number, body in enumerate(blocks(page, language), start=1)
    ]


def anchors(page: Path) -> set[str]:
    """What links into a page may name, as GitHub makes it of headings."""
    prose = _FENCE.sub("", page.read_text())
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(page: Path, link: str) -> str:
    """What is wrong with a link; empty where it leads somewhere."""
    if link.startswith(("http://", "https://")):
        return ""
    path, _, anchor = link.partition("#")
    target = (page.parent / path).resolve() if path else page
    if not target.exists() or not target.is_relative_to(ROOT):
        return f"{page.relative_to(ROOT)}: {link} does not exist"
    if page.is_relative_to(DOCS) and not target.is_relative_to(DOCS):
        return f"{page.relative_to(ROOT)}: {link} leaves docs/, where the site has nothing"
    return f"{page.relative_to(ROOT)}: {link} has no such heading" if anchor and anchor not in anchors(target) else ""


def test_every_link_leads_somewhere():
    links = [(p, link) for p in PAGES for link in re.findall(r"\]\(([^)\s]+)\)", _FENCE.sub("", p.read_text()))]
    assert len(links) > 200
    assert [problem for page, link in links if (problem := broken(page, link))] == []


def test_every_page_is_in_the_index_and_on_the_site():
    index = set()
    for folder in (DOCS, DOCS / "dev", DOCS / "devices"):
        links = re.findall(r"\]\(([^)#\s]+)", (folder / "README.md").read_text())
        index |= {folder / "README.md", *((folder / link).resolve() for link in links)}
    assert {page for page in PAGES if page.is_relative_to(DOCS)} - index == set()
    nav = (ROOT / "mkdocs.yml").read_text().split("\nnav:")[1].split("\nplugins:")[0]
    listed = {DOCS / name for name in re.findall(r"[\w/-]+\.md", nav)}
    assert {page for page in PAGES if page.is_relative_to(DOCS)} == {path for path in listed if path.is_file()}


def test_the_site_builds(tmp_path):
    """With every link and anchor, and every public name that the page of the interface lists."""
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None:
        pytest.skip("mkdocs is not installed (extra docs)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    page = (tmp_path / "api.html").read_text()
    assert [name for name in colmap_inertial.__all__ if f'id="colmap_inertial.{name}"' not in page] == []


def test_generated_pages_are_up_to_date():
    stale = [str(p.relative_to(ROOT)) for p, text in GENERATED.items() if not p.is_file() or p.read_text() != text]
    assert stale == [], "run python scripts/make_reference.py"


def test_every_command_parses(tmp_path):
    (tmp_path / "config.toml").write_text(config_as_toml(ReconstructOptions()))
    wrong = []
    for where, block in every("sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if not words or Path(words[0]).name != "colmap-inertial" or words[1:] == ["--version"]:
                continue
            if "--config" in words:
                words[words.index("--config") + 1] = str(tmp_path / "config.toml")
            try:
                parse(words[1:])
            except SystemExit as stopped:
                wrong.append((where, line, stopped.code))
    assert wrong == []


def test_commands_in_the_text_exist(capsys):
    with pytest.raises(SystemExit):
        parse(["--help"])
    shown = capsys.readouterr().out
    named = set(re.findall(r"`colmap-inertial ([a-z][\w-]*)", TEXT))
    named |= set(re.findall(r"^\| `([a-z][\w-]*) [A-Z]{2,}", (ROOT / "README.md").read_text(), re.MULTILINE))
    assert {"reconstruct", "scale", "validate", "export"} <= named
    assert [verb for verb in named if not re.search(rf"\b{verb}\b", shown)] == []


def test_every_option_of_reconstruct_is_explained(capsys):
    with pytest.raises(SystemExit):
        parse(["reconstruct", "--help-all"])
    shown = capsys.readouterr().out
    options = {
        name for name in re.findall(r"(?<![^\s│])--[a-z][\w.-]*[a-z0-9]", shown) if not re.search(r"\bno-", name)
    }
    options -= {"--help", "--help-all", "--out"}  # the second one is that of align
    assert len(options) > 20
    # what the pages leave to --help: how COLMAP works, and reproducibility
    left = {"--mapping.pairing", "--mapping.overlap", "--mapping.max-image-size", "--mapping.max-num-features"}
    left |= {"--mapping.first-octave", "--deterministic", "--seed", "--scale.max-offset-s"}
    assert "colmap-inertial COMMAND --help" in TEXT
    assert left <= options
    assert {option for option in options - left if not re.search(rf"{re.escape(option)}(?![\w-])", TEXT)} == set()


# --- the package from within -----------------------------------------------------------------------------------------


#: A benchmark or study by the command that runs it.
_SCRIPT = re.compile(r"python -m (scripts(?:\.\w+)+)")


def test_names_of_the_code_exist():
    """Functions, types, fields, packages and files that the pages for contributors name; scripts and tests of all."""
    package = ROOT / "colmap_inertial"
    files = [*package.rglob("*.py"), *(package / "_kernels").glob("*.[ch]*")]
    known = {word for file in files for word in re.findall(r"\w+", file.read_text())}
    unknown = []
    for page in PAGES:
        prose = _FENCE.sub("", page.read_text())
        paths = re.findall(r"`(?:python |bash )?((?:scripts|tests)/[\w/]+\.(?:py|sh))\b", prose)
        paths += [f"{name.replace('.', '/')}.py" for name in _SCRIPT.findall(page.read_text())]
        words = []
        if page in DEVELOPERS:
            paths += re.findall(r"`((?:\w+/)+\w+(?:\.py)?)`", prose)
            words = re.findall(r"`((?:_[A-Z]|[A-Za-z])[\w.]*)(?:\(\))?`", prose)
        unknown += [(page.name, path) for path in paths if not any((root / path).exists() for root in (ROOT, package))]
        words = [word for word in words if not re.search(r"\.(db|html|json|md|npz|py|toml|tum)$", word)]
        names = {name for word in words for name in word.split(".") if re.search(r"_|[A-Z]", name)}
        unknown += [(page.name, name) for name in names - known]
    assert unknown == []


def test_figures_name_options_that_their_scripts_have():
    """Each ``python -m scripts.FOLDER.NAME --option`` of the pages."""
    unknown = []
    commands = re.findall(rf"`{_SCRIPT.pattern}((?:\s[^`]*)?)`", TEXT)
    assert len(commands) > 30
    for name, arguments in commands:
        text = (ROOT / f"{name.replace('.', '/')}.py").read_text()
        unknown += [(name, o) for o in re.findall(r"--[a-z][\w-]*", arguments) if f'"{o}"' not in text]
    assert unknown == []


def test_the_public_names_are_those_of_the_api_reference():
    listed = re.findall(r"^::: colmap_inertial\.(\w+)$", (DOCS / "api.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(colmap_inertial.__all__)


def test_every_command_but_the_viewer_is_a_public_function():
    table = (DOCS / "api.md").read_text().split("\n## ", 1)[0]
    rows = re.findall(r"^\| (`[a-z`, -]+`) \| (.*) \|$", table, re.MULTILINE)
    commands = {command for cell, _ in rows for command in re.findall(r"`([\w-]+)`", cell)}
    assert sorted(commands) == sorted(name for group in GROUPS.values() for name in group)
    for cell, functions in rows:
        named = re.findall(r"`(\w+)`", functions)
        assert cell == "`view`" or named, cell
        assert set(named) <= set(colmap_inertial.__all__), cell


def test_every_field_of_a_result_and_of_the_options_is_in_its_docstring():
    for result in (ReconstructResult, ModelResult, Fragment, ReconstructOptions):
        text = "".join(kind.__doc__.partition("Attributes")[2] for kind in result.__mro__[:-1])
        listed = {name for line in re.findall(r"^    (\w.*)$", text, re.MULTILINE) for name in line.split(", ")}
        assert {f.name for f in dataclasses.fields(result)} - listed == set(), result


# --- captures --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def imu(project):
    """Twenty seconds of a handheld recording; the clock was started before it."""
    recorded = project.recording.imu
    first, second = (t_s < recorded.gyro_t_s[0] + 20 for t_s in (recorded.gyro_t_s, recorded.accel_t_s))
    return dataclasses.replace(
        recorded,
        gyro_t_s=recorded.gyro_t_s[first],
        gyro_rad_s=recorded.gyro_rad_s[first],
        accel_t_s=recorded.accel_t_s[second],
        accel_m_s2=recorded.accel_m_s2[second],
        epoch_ns=recorded.epoch_ns + 10**15,
    )


SHEET = """
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.6, 457.3, 367.2, 248.4]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""


def write_files(folder: Path, imu, names: set[str]) -> None:
    """The files of a capture.toml, each as its recorder writes it."""
    frame_ns = imu_files.stamps_ns(imu, imu.gyro_t_s[:: max(1, len(imu.gyro_t_s) // 60)])
    times = "".join(f"{t}\n" for t in frame_ns)
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.startswith("GX"):
            imu_files.write_gopro(path, imu)
        elif name.startswith("DJI_") and path.suffix == ".MP4":
            imu_files.write_dji(path)
        elif path.suffix.lower() in (".mp4", ".mov") and not path.exists():
            imu_files.write_mp4(path, [imu_files.video_track(len(frame_ns))])
        elif path.suffix == ".gcsv":
            imu_files.write_gcsv(path, imu)
        elif name.startswith("RC_GyroData"):
            imu_files.write_runcam(folder, imu, "Runcam 5 Orange")
        elif path.suffix == ".zip":
            imu_files.write_sensor_logger(folder, imu, standardised=True).rename(path)
        elif path.suffix == ".bag":
            imu_files.write_rosbag(path, imu)
        elif name == "8653a2142b":
            path.mkdir(exist_ok=True)
            imu_files.write_stray_scanner(path, imu, frame_ns)
        elif name.endswith("gyro.csv"):
            imu_files.write_opencamera(folder, imu, frame_ns, name.removesuffix("gyro.csv"))
        elif name == "mav0/imu0":
            path.mkdir(parents=True, exist_ok=True)
            head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
            head += "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
            write_table(path / "data.csv", imu, "ns", "rad/s", "m/s2", head)
        elif path.suffix == ".yaml":
            path.write_text(SHEET)
        elif name == "imu.csv":
            head = "t [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s2],ay [m/s2],az [m/s2]"
            write_table(path, imu, "s", "rad/s", "m/s2", head)
        elif name.endswith("cam1/data.csv"):
            path.write_text("#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in frame_ns))
        elif name == "frames.csv":
            path.write_text("name,t_ns\n" + "".join(f"{i}.jpg,{t}\n" for i, t in enumerate(frame_ns)))
        elif name == "clip_times.csv":
            path.write_text(times)


def write_table(path: Path, imu, time_unit: str, gyro_unit: str, accel_unit: str, header: str) -> None:
    per_second = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[time_unit]
    gyro = imu.gyro_rad_s if gyro_unit == "rad/s" else np.degrees(imu.gyro_rad_s)
    accel = np.stack([np.interp(imu.gyro_t_s, imu.accel_t_s, column) for column in imu.accel_m_s2.T], axis=1)
    accel = accel if accel_unit == "m/s2" else accel / 9.80665
    t = imu.gyro_t_s - imu.gyro_t_s[0]
    stamps = [str(round(x * per_second)) if time_unit != "s" else f"{x:.9f}" for x in t]
    rows = [",".join([s, *(f"{v:.7f}" for v in (*g, *a))]) for s, g, a in zip(stamps, gyro, accel, strict=True)]
    path.write_text("\n".join([header, *rows] if header else rows) + "\n")


def names_in(values: object) -> set[str]:
    """Every text of a capture.toml that may be a path."""
    if isinstance(values, dict):
        return set().union(*(names_in(value) for value in values.values()))
    return {values} if isinstance(values, str) and re.search(r"\.\w+$|^mav0/imu0$|^8653", values) else set()


def test_every_toml_is_read(tmp_path, imu):
    unread = []
    for number, (where, text) in enumerate(every("toml")):
        folder = tmp_path / str(number)
        folder.mkdir()
        try:
            check_toml(folder, text, imu)
        except (AssertionError, InertialError, KeyError, ValueError) as error:
            unread.append((where, repr(error)))
    assert unread == []


def check_toml(folder: Path, text: str, imu) -> None:
    """Read a capture.toml, or a manifest, and the recording that it names."""
    values = tomllib.loads(text)
    if "capture" in values:
        (folder / "captures.toml").write_text(text)
        assert len(read_manifest(folder / "captures.toml", allow_stages=True)) == len(values["capture"])
        return
    if not {"images", "video"} & values.keys():  # one table of the reference
        text = 'video = "clip.mp4"\n' + text
    (folder / "capture.toml").write_text(text)
    tables = [values["imu"][s] for s in ("gyro", "accel") if "file" in values.get("imu", {}).get(s, {})]
    write_files(folder, imu, names_in(values))
    capture = load_capture(folder)
    assert isinstance(capture, Capture)
    if isinstance(capture.imu, ImuTables):
        for table in tables:
            write_described(folder / table["file"], imu, capture.imu, table)
    corrected = {"gyro", "accel"} & values.get("imu", {}).keys() and not tables
    if capture.imu is None or corrected:
        return
    if "RC_GyroData" in text and importlib.util.find_spec("telemetry_parser") is None:
        return  # its reader is an extra
    assert read_capture_imu(capture).has_accel
    if isinstance(capture.frames, Video) and capture.frames.frame_times is not None:
        return  # one time for each frame of a video that nobody can decode here
    if not isinstance(capture.frames, Video) and capture.frames is not None and capture.frames.times != "name":
        assert len(read_frame_times(capture.frames.times).names) > 0


def write_described(path: Path, imu, described: ImuTables, table: dict) -> None:
    """A table with the columns that a capture.toml says it has; it holds both sensors, whichever is read from it."""
    if described.gyro_axes is not None:  # the reader turns it back
        imu = dataclasses.replace(imu, gyro_rad_s=imu.gyro_rad_s @ described.gyro_axes.matrix)
    names = "t,gx,gy,gz,ax,ay,az" if isinstance(table["columns"][0], str) else ""
    accel_unit = "m/s2" if described.accel is None else described.accel.unit
    write_table(path, imu, table["time_unit"], described.gyro.unit, accel_unit, names)


def test_the_reference_names_every_format_and_every_key():
    page = (DOCS / "capture-toml.md").read_text()
    assert {f.name for f in imu_formats() if f"`{f.name}`" not in page} == set()
    keys = set()
    for file in ("capture.py", "capture_tables.py", "camera_table.py", "frame_sources.py", "capture_rig.py"):
        if file == "capture_rig.py":
            page += (DOCS / "special-cameras.md").read_text()
        source = (ROOT / "colmap_inertial" / "io" / file).read_text()
        reads = r"(?:file|text|number|numbers|matrix|choice|boolean|integer|positive|raw)"
        keys |= set(re.findall(rf'\.{reads}\("([a-z_]+)"', source))
    assert len(keys) > 30
    assert {key for key in keys if f"{key}" not in page} == set()


# --- findings and results --------------------------------------------------------------------------------------------


def test_every_finding_is_explained():
    # those of findings are named in their module, as functions or by their codes, and made in no other
    source = Path(findings.__file__).read_text()
    others = "".join(
        path.read_text() for path in Path(findings.__file__).parent.glob("*.py") if path.stem != "findings"
    )

    def is_made(code: str, text: str) -> bool:
        return any(
            form in text for form in (f"def {code.replace('-', '_')}(", f'state("{code}"', f'state(\n    "{code}"')
        )

    named = {code for code in all_messages() if is_made(code, source) or f'"{code}"' in source}
    codes = {code for code in named if is_made(code, source) or not is_made(code, others)}
    explained = (DOCS / "troubleshooting.md").read_text()
    rows = explained[explained.index("### IMU") :].splitlines()
    listed = {code for row in rows if row.startswith("| `") for code in re.findall(r"`([a-z-]+)`", row.split("|")[1])}
    assert listed == codes


def said(folder: Path) -> list[str]:
    """Every text in the code of a folder, with a line break for each value that is put in."""
    found = []
    for file in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(p.value if isinstance(p, ast.Constant) else "\n" for p in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_every_reason_in_the_text_is_one_that_is_printed():
    page = (DOCS / "troubleshooting.md").read_text()
    table = page[page.index("| text (in part)") :].split("\n\n")[0]
    texts = [text for text in said(ROOT / "colmap_inertial" / "messages")]
    phrases = [
        part.strip()
        for row in table.splitlines()[2:]
        for part in re.split(r"\.\.\.|;|:|±|\(|\)", row.split("|")[1])
        if len(part.strip()) > 8
    ]
    assert len(phrases) > 30
    assert [phrase for phrase in phrases if not any(phrase in text for text in texts)] == []


@pytest.fixture(scope="module")
def examples(tmp_path_factory, project):
    """The folder in which the page on Python says that its examples stand, and what they leave in it."""
    folder = tmp_path_factory.mktemp("examples")
    copy_scene(folder / "capture", first=FRAMES, target=True)
    (folder / "options.toml").write_text(config_as_toml(TINY))
    shutil.copytree(project.model.parents[1], folder / "project")
    (folder / "project" / "frames.csv").write_bytes(project.frame_times.read_bytes())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        values: dict[str, object] = {"__name__": "__main__"}
        for number, code in enumerate(blocks(DOCS / "python.md", "python")):
            exec(compile(code, f"python.md block {number + 1}", "exec"), values)
    return folder, values


def test_the_examples_in_python_run(examples):
    folder, values = examples
    result = values["result"]
    assert {frame.action for frame in result.frames} == {Action.CHANGED}
    assert [treatment.stage for model in result.models for treatment in model.treatments] == ["refine", "well_seen"]
    assert values["estimate"].verdict == "trusted"
    assert (folder / "metric_model" / "transform.json").is_file()
    assert (folder / "project_metric" / "sparse" / "0").is_dir()


def test_the_notebook_runs_from_a_capture_to_a_distance(examples, monkeypatch):
    folder, values = examples
    monkeypatch.chdir(folder)
    cells = json.loads((DOCS / "measure.ipynb").read_text())["cells"]
    known: dict[str, object] = {"capture": "capture", "out": "out", "options": values["options"]}
    for cell in cells:
        if cell["cell_type"] == "code" and "parameters" not in cell["metadata"].get("tags", ()):
            exec(compile("".join(cell["source"]), f"measure.ipynb {cell['id']}", "exec"), known)
    assert known["result"].unchanged and 0.01 < known["length_m"] < 5
    for value in (known["imu"], known["result"], known["model"], known["model"].scale, known["model"].validation):
        lines = repr(value).splitlines()
        assert len(lines) <= 20 and max(map(len, lines)) <= 140
        assert value is None or value._repr_html_().startswith("<table>")


def test_every_example_in_python_compiles():
    for where, text in every("python"):
        compile(text, where, "exec")


def test_results_have_the_form_that_their_schemas_describe(examples, project, tmp_path):
    folder, _ = examples
    for run in ("out", "out_hooks"):
        for name in ("result", "report", "diagnosis"):
            assert find_violations(name, json.loads((folder / run / f"{name}.json").read_text())) == []
    content = read_schema("result").schema
    treatment = Draft202012Validator({**content["$defs"]["treatment"], "$defs": content["$defs"]})
    frames, keypoints = (
        json.loads((folder / "out_hooks" / f"{name}.json").read_text()) for name in ("frames", "keypoints")
    )
    assert {frozenset(record) for record in frames["frames"]} == {
        frozenset(("name", "action", "sharpened", "rectified", "camera", "treatments"))
    }
    assert {frozenset(record) for record in keypoints["images"]} == {frozenset(("name", "rectified", "treatments"))}
    treatments = [one for record in [*frames["frames"], *keypoints["images"]] for one in record["treatments"]]
    assert len(treatments) >= len(frames["frames"])
    assert all(treatment.is_valid(one) for one in treatments)

    flags = ["--imu", project.imu, "--frame-times", project.frame_times]
    for args, code in (
        (["scale", project.model, *flags, "--json", tmp_path / "scale.json"], 0),
        (["scale", project.model, *flags, "--json", tmp_path / "short.json", "--first-s", 0.2], 3),
        (["scale", project.model, *flags, "--json", tmp_path / "spectral.json", "--method", "spectral"], 0),
        (["reconstruct", project.model.parents[1], tmp_path / "project", *flags], 0),
        (["diagnose", project.model, *flags, "--json", tmp_path / "diagnosis.json"], 0),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(list(map(str, args)))
        assert stopped.value.code == code, args
    for name in ("scale", "short", "spectral"):
        assert find_violations("scale", json.loads((tmp_path / f"{name}.json").read_text())) == []
    assert find_violations("diagnosis", json.loads((tmp_path / "diagnosis.json").read_text())) == []
    for name in ("result", "report"):
        assert find_violations(name, json.loads((tmp_path / "project" / f"{name}.json").read_text())) == []


def test_a_stopped_run_and_one_with_every_section_fit_the_schema_of_the_report(tmp_path):
    for kind in ("orbit", "constant_velocity"):
        write_run(tmp_path / kind, kind=kind, duration_s=10.0)
        write_report(tmp_path / kind)
        content = json.loads((tmp_path / kind / "report.json").read_text())
        for finding in content["findings"]["findings"]:
            finding.setdefault("numbers", {})  # the fixture's is shorter than those of diagnose
        assert find_violations("report", content) == []

    capture = tiny_capture(tmp_path / "capture")
    for path in (capture / "frames").iterdir():
        cv2.imwrite(str(path), np.full((240, 320, 3), 120, np.uint8))
    with pytest.raises(NotObservableError):
        reconstruct(capture, tmp_path / "out", TINY)
    for name in ("report", "diagnosis"):
        assert find_violations(name, json.loads((tmp_path / "out" / f"{name}.json").read_text())) == []


def test_what_is_done_to_frames_has_the_form_that_the_schema_describes(imu, tmp_path):
    """The parts of a result that only longer runs fill."""
    timing = FrameTiming(names=("a.jpg", "b.jpg"), t_s=np.array([0.0, 0.1]))
    camera = CameraModel(model="PINHOLE", width=640, height=480, params=(500.0, 500.0, 320.0, 240.0))
    view = GyroView(imu=imu, timing=timing, calibration=calibration_prior(), camera=camera, source="model")
    parallax = Parallax(
        width=640, height=480, step_px=27, velocity_in_cam=np.ones(3), inverse_depth=np.full((19, 25), 0.5)
    )
    verdict = RecordingVerdict(trusted=None, support=5.0, extent_factor=1.0, frames=4, reason="so")
    plan = ImagingPlan(view=view, deblur=((), verdict), parallaxes={"a.jpg": parallax}, rectify=True)
    window = Chosen(
        place=3, closed_by="start", ranked_by="blur", blur=np.nan, first=0, last=5, baseline=0.1, motion=np.nan
    )
    selection = Selection(
        names=("b.jpg",), frames=9, note=Fact.stated("so"), windows=(window,), offset_s=0.1, offset_from="pixels"
    )
    dense = DenseResult(folder=tmp_path / "dense" / "0", images=4, depth_maps=0, maps="plane sweep", waiting="none")
    values = {"blur_px": 4.0, "kept_share": 0.2, "extent_factor": 1.1}
    treated = Treatment(stage="deblur", reason="so", action="deblurred", values=values)
    record = FrameRecord(name="a.jpg", action="deblurred", sharpened=True, camera=camera, treatments=(treated,))
    write_json(
        tmp_path / "parts.json",
        {
            "imaging": imaging_as_json(plan, {"a.jpg"}),
            "selection": selection.as_json(),
            "dense": dense.as_json(tmp_path),
            "frame": frame_as_json(record, plan, {"a.jpg"}),
        },
    )
    parts = json.loads((tmp_path / "parts.json").read_text())
    content = read_schema("result").schema
    fields = content["properties"]
    for name, form in (
        ("imaging", fields["imaging"]),
        ("selection", fields["selection"]),
        ("dense", content["$defs"]["dense"]),
        ("frame", fields["frames"]["items"]),
    ):
        validator = Draft202012Validator({**form, "$defs": content["$defs"]})
        assert [error.message for error in validator.iter_errors(parts[name])] == [], name


def test_images_are_written_out_of_a_bag(tmp_path, monkeypatch):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    image, header, time = (
        store.types[name] for name in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    rng = np.random.default_rng(0)
    pictures = {1_700_000_000_000_000_000 + i: rng.integers(0, 255, (6, 8, 3), dtype=np.uint8) for i in (1, 2)}
    with Writer(tmp_path / "flight.bag") as writer:
        connection = writer.add_connection("/cam0/image_raw", image.__msgtype__, typestore=store)
        for t, picture in pictures.items():
            padded = np.concatenate([picture.reshape(6, -1), np.zeros((6, 3), np.uint8)], axis=1)  # rows are aligned
            stamp = time(sec=t // 10**9, nanosec=t % 10**9)
            message = image(
                header=header(seq=0, stamp=stamp, frame_id="cam"),
                height=6,
                width=8,
                encoding="rgb8",
                is_bigendian=0,
                step=27,
                data=padded.ravel(),
            )
            writer.write(connection, t, bytes(store.serialize_ros1(message, image.__msgtype__)))
    monkeypatch.chdir(tmp_path)
    (code,) = blocks(DOCS / "devices" / "ros.md", "python")
    exec(compile(code, "ros.md", "exec"), {})
    for t, picture in pictures.items():
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "frames" / f"{t}.png"))[:, :, ::-1], picture)


def test_the_examples_pass_a_type_checker(tmp_path):
    """As a user's editor sees them: pyright's rules, and the package as it is typed. ``scripts/test.sh`` asks mypy."""
    written = write_examples(tmp_path)
    assert [path.name for path in written if "colmap_inertial" not in path.read_text()] == [] and len(written) == 3
    if importlib.util.find_spec("basedpyright") is None:
        pytest.skip("basedpyright is not installed (extra complete)")
    settings = {"include": ["."], "typeCheckingMode": "standard", "extraPaths": [str(ROOT)]}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "basedpyright", "--level", "error", "--pythonpath", sys.executable]
    checked = subprocess.run([*command, "-p", str(tmp_path)], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout

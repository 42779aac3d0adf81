"""What a release carries: one version, licences, a citation, links that lead somewhere."""

import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import yaml

import colmap_inertial
from scripts.index_readme import LINK, absolute

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_there_is_one_version_and_the_changelog_has_it():
    version = PROJECT["project"]["version"]
    assert colmap_inertial.__version__ == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert f"\n## {version}\n" in (ROOT / "CHANGELOG.md").read_text()


def test_the_citation_names_what_is_followed():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["authors"] == [{"name": "the colmap-inertial authors"}]
    sources = " ".join((ROOT / "docs" / "dev" / "sources.md").read_text().lower().split())
    titles = [reference["title"].lower().replace("lsd2 - ", "lsd2: ") for reference in citation["references"]]
    assert titles and [title for title in titles if title not in sources] == []


def test_licences_of_what_is_compiled_in_go_along():
    for name in PROJECT["project"]["license-files"]:
        assert (ROOT / name).is_file()
    text = (ROOT / "THIRD_PARTY_LICENSES.txt").read_text()
    assert "nanobind" in text and "Redistributions in binary form" in text and "robin_map" in text


#: What GPL code in a wheel is told by: bytes of a library in it, and the names under which it is declared.
GPL_PARTS = {
    "CHOLMOD": ("pycolmap", b"/CHOLMOD/Supernodal/cholmod_super_numeric.c"),
    "MatrixOps": ("pycolmap", b"/CHOLMOD/MatrixOps/"),
    "SuiteSparseQR": ("pycolmap", b"/SPQR/Source/SuiteSparseQR.cpp"),
    "libx264": ("av", b"libx264-"),
    "libx265": ("av", b"libx265-"),
}


def test_gpl_code_that_the_dependencies_bring_is_declared():
    """Licences: SuiteSparse's CHOLMOD/Doc/License.txt and SPQR/Doc/License.txt; x264's and x265's COPYING."""
    for name, (package, mark) in GPL_PARTS.items():
        libraries = [file for file in distribution(package).files or () if ".so" in file.name]
        assert libraries
        if not any(mark in Path(str(file.locate())).read_bytes() for file in libraries):
            continue
        for page in ("docs/start.md", "THIRD_PARTY_LICENSES.txt"):
            assert name in (ROOT / page).read_text(), (page, name)
        (line,) = [line for line in (ROOT / "pyproject.toml").read_text().splitlines() if f'  "{package}>=' in line]
        assert "GPL" in line


def test_links_of_the_readme_lead_to_files_and_become_addresses(tmp_path):
    text = (ROOT / "README.md").read_text()
    targets = [target.split("#")[0] for _, target, _ in LINK.findall(text)]
    assert len(targets) > 10 and all((ROOT / target).exists() for target in targets)
    made = absolute(text, "https://code.example/it/", "0.2.0")
    assert not LINK.search(made)
    assert "](https://code.example/it/blob/v0.2.0/docs/results.md)" in made
    assert "](https://code.example/it/raw/v0.2.0/docs/images/desk.jpg)" in made


def test_the_address_stands_in_one_place(subtests, tmp_path_factory):
    for urls in ("", '\n[project.urls]\nRepository = "https://code.example/it"\n'):
        with subtests.test(urls=urls):
            tmp_path = tmp_path_factory.mktemp("given")
            (tmp_path / "scripts").mkdir()
            shutil.copy(ROOT / "scripts" / "index_readme.py", tmp_path / "scripts")
            (tmp_path / "pyproject.toml").write_text(f'[project]\nversion = "1.2"\n{urls}')
            (tmp_path / "README.md").write_text("[a](docs/a.md#b) [c](#c) [d](https://d.example)")
            done = subprocess.run(
                [sys.executable, "scripts/index_readme.py"], cwd=tmp_path, capture_output=True, text=True
            )
            text = (tmp_path / "README.md").read_text()
            if urls:
                assert done.returncode == 0
                assert text == "[a](https://code.example/it/blob/v1.2/docs/a.md#b) [c](#c) [d](https://d.example)"
            else:
                assert done.returncode == 2 and "fill in [project.urls]" in done.stderr and "docs/a.md" in text


def test_workflows_run_what_is_there(subtests):
    for path in WORKFLOWS:
        with subtests.test(path=path):
            text = path.read_text()
            jobs = yaml.safe_load(text)["jobs"]
            assert jobs and all(job["steps"] for job in jobs.values())
            for name in re.findall(r"(?:scripts|tests)/[\w./]+", text):
                assert (ROOT / name).is_file(), name
            if "macos" in text:
                assert "NOT VERIFIED YET" in text

"""An output does not lie among the pictures that it is made from."""

import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError, OutputError
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frame_sources import ImageFolder, image_names
from colmap_inertial.io.frames import picture_folders
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.steps.session import open_session
from tests.helpers.batch_captures import TINY, tiny_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return tiny_capture(tmp_path_factory.mktemp("apart") / "capture")


def listing(folder):
    return sorted(folder.rglob("*"))


def test_an_output_among_the_pictures_is_refused(subtests, capture, tmp_path_factory):
    for out in ("", "out", "deep/er/out"):
        with subtests.test(out=out):
            tmp_path = tmp_path_factory.mktemp("given")
            (folder,) = picture_folders(load_capture(capture))
            before = listing(capture)
            with pytest.raises(OutputError, match="the folder of the capture's images; choose a folder outside of it"):
                reconstruct(capture, folder / out, TINY)
            (tmp_path / "link").symlink_to(folder)
            with pytest.raises(OutputError, match="the capture's images"):
                reconstruct(capture, tmp_path / "link" / "out", TINY)
            assert listing(capture) == before


def test_the_command_line_says_so(subtests, capture, capsys):
    for command in ("reconstruct", "deblur"):
        with subtests.test(command=command):
            capsys.readouterr()
            (folder,) = picture_folders(load_capture(capture))
            before = listing(capture)
            with pytest.raises(SystemExit) as stopped:
                main([command, str(capture), str(folder / "out")])
            assert stopped.value.code == 2
            assert "choose a folder outside of it" in capsys.readouterr().err
            assert listing(capture) == before


def test_every_folder_of_pictures_counts_and_others_do_not(tmp_path):
    for name in ("short", "long"):
        (tmp_path / name).mkdir()
    folders = (tmp_path / "short", tmp_path / "long")
    with (
        pytest.raises(OutputError, match="long"),
        open_session(tmp_path / "long" / "out", tmp_path, TINY, pictures=folders),
    ):
        pass
    with open_session(tmp_path / "longer", tmp_path, TINY, pictures=folders):
        pass


def test_a_pattern_stays_in_its_folder(subtests, tmp_path_factory):
    for pattern in ("../*.png", "/etc/*.png", "a/../../*"):
        with subtests.test(pattern=pattern):
            tmp_path = tmp_path_factory.mktemp("given")
            with pytest.raises(FormatError, match="leads outside of it"):
                image_names(ImageFolder(folder=tmp_path, pattern=pattern))

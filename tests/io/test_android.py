"""Folders of Android recorders."""

from colmap_inertial.io.android import is_opencamera


def test_a_folder_is_opencamera_s_where_each_gyroscope_s_file_has_bare_rows(tmp_path):
    (tmp_path / "a_gyro.csv").write_text("0.1,0.2,0.3,123\n")
    assert is_opencamera(tmp_path)
    (tmp_path / "b_gyro.csv").write_text("t,x,y,z\n1,2,3,4\n")
    assert not is_opencamera(tmp_path)

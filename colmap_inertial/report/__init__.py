"""The report of a run: ``OUT/report.html`` for reading, ``OUT/report.json`` with the same content.

It is made from the files of an output folder alone (``result.json``, ``diagnosis.json``, ``config.toml``,
``validation/``, ``report_data/``), so that it can be made again; nothing is estimated anew.

``report.json``, version 1. Times ``t_s`` count from the first frame; ``{"missing": "..."}`` stands for a section that
the run has no data for, with the reason. A line is ``{"t_s": [...], "values": [...]}``, thinned to its smallest and
largest values, ``null`` for gaps; three lines are x, y, z.

=================  =====================================================================================================
``format``         ``"colmap-inertial report"``; ``version``: 1, counts changes of this layout
``title``          name of the capture; ``capture``: its path
``outcome``        ``verdict`` (``trusted``, ``weak``, ``refused``; ``stopped`` where the run ended before a model),
                   ``headline``, ``answers`` (question and answer), ``summary``, ``tried`` and ``todo`` (sentences);
                   of the first model
``models``         those with a scale first, then by size; each as in ``result.json`` (``metres_per_unit``, ``ci95``,
                   ``verdict``, ``reasons``, calibration, ``readout_translation``, ...), with

                   - ``half_width_pct`` of the interval; ``outcome`` as above
                   - ``drift``: as in ``result.json``, or missing
                   - ``validation``: as in ``result.json`` with ``pictures`` (paths), or missing
                   - ``scene``, ``photogrammetry``, ``signals``: see below, or missing
``gaps``           between COLMAP's models, as in ``result.json``
``findings``       ``checked`` and ``findings`` of ``diagnosis.json``, or missing
``selection``      of a video's frames: ``frames``, ``used`` and ``note``; ``null`` where unknown
``recording``      ``imu`` (``device``, ``gyro_hz``, ``accel_hz``, ``duration_s``) and ``frames`` (``count``,
                   ``duration_s``, ``interval_s``, ``median_exposure_s``, ``readout_s``); ``null`` where unknown
``blur``           ``note``, ``counts`` by action, ``median_px``, ``largest_px``, ``frames`` (``name``, ``t_s``,
                   ``blur_px``, ``action``, ``reason``), or missing
``frame_table``    ``count``, and ``rows`` of the most blurred frames (``name``, ``t_s``, ``blur_px``, ``action``,
                   ``sharpened``, ``rectified``, ``reason``, ``image``: path of its image), or missing
``crops``          ``pairs`` (``name``, ``blur_px``, ``reason``, and the paths ``before`` and ``after``), or missing
``rolling_shutter``  ``note``, ``readout_s``, ``t_s``, ``median_px``, ``largest_px`` (movement of keypoints in each of
                   some frames), ``worst`` (``name``, ``width``, ``height``, ``at_px``, ``shift_px`` over a grid), or
                   missing
``made``           ``date``, ``machine``, ``processors``; ``null`` of earlier runs
``project_metric``  the whole project in metres, where an existing one was given, or ``null``
``seconds``        by stage
``configuration``  ``toml`` text and ``values``, or missing
``versions``       of this package and of what it ran with
=================  =====================================================================================================

``scene``: ``unit`` (``m`` or ``model``), ``gravity_known``, ``display_from_model_xyzw`` (what rotated the model
upright), ``points_in_model``, ``points`` (``xyz`` as three lists, ``rgb``), ``path`` (``t_s``, ``xyz``),
``path_length``, ``cameras`` (``xyz``, unit vectors ``right``, ``down``, ``ahead``, and the image's ``half_width`` and
``half_height`` at distance 1).

``photogrammetry``: ``unit``, ``cameras`` (``camera_id``, ``model``, ``width``, ``height``, ``images``, ``params``,
``sigma`` of those that were free, ``field_of_view_deg``, ``distortion``: ``at_px`` and ``shift_px``), ``images``
(``name``, ``observations``, ``rms_px`` of their residuals, ``gsd``: length of a pixel at the median depth), ``sensor``
(residuals in ``columns`` times ``rows`` cells: ``count``, ``mean_x_px``, ``mean_y_px``, ``rms_px``), ``tracks``
(``mean`` length, ``counts`` of points seen by 2, 3, ..., 12 or more images), ``extent`` along x, y and up, ``ground``
(``x0``, ``y0``, ``step``, and the ``images`` that see each square from above).

``signals``: ``duration_s``, ``frames``, ``first_frame_s`` (on the camera's clock: where ``t_s`` counts from),
``alignment`` of camera and IMU (``found``, ``failed``, or ``not tried`` where the recording cannot be used), and

- ``rotation``: ``same_clock_origin``; ``before``: ``camera`` (camera axes) and ``gyroscope`` (its own axes), three
  lines each, rad/s (with ``camera_size`` and ``gyroscope_size`` where they could not be aligned); ``after``: both in
  camera axes and on the camera's clock, ``rms_difference_rad_s``, ``rms_rate_rad_s``; or ``null``; ``deviation_deg``:
  how far each camera of COLMAP's model is turned against those around it, by the gyroscope; or ``null``
- ``acceleration``: ``camera`` (``camera_unit``) and ``accelerometer`` (m/s2), three lines each: two horizontal
  directions and up, of the IMU's place, without gravity and bias, by second differences averaged over
  ``averaged_over_s``; ``correlation``, ``rms_camera``, ``rms_accelerometer_m_s2``; or missing
- ``rotation_spectrum``, ``acceleration_spectrum``: ``curves`` by name (``camera``, ``imu_at_frames``: the IMU seen as
  the frames see it, ``imu``: its own samples), each ``hz`` and ``density`` (unit per root hertz, all axes); or missing
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.printing import printable_values
from colmap_inertial.io.files import StrPath, reading, refuse_link, write_json, write_text
from colmap_inertial.report.content import gather
from colmap_inertial.report.folders import DATA_FOLDER

#: Files and folders of a run that its report is made of.
_READ = ("result.json", "diagnosis.json", "config.toml", DATA_FOLDER, "validation")


def write_report(
    out: StrPath, *, result: dict[str, Any] | None = None, stopped: str | None = None, capture: str | None = None
) -> Path:
    """Write ``report.html`` and ``report.json`` of a run.

    Parameters
    ----------
    out
        Folder of a run of ``reconstruct``.
    result
        Content of ``result.json``, where it is not written yet.
    stopped
        Why the run ended without a result, where it did.
    capture
        What was run, where there is no result to say so.

    Returns
    -------
    Path of the page.

    Raises
    ------
    FormatError
        Where the folder holds no finished run, a link in what is read, or files that were damaged since.
    OutputError
        Where it cannot be written.
    """
    out = Path(out)
    for name in _READ:
        for path in (out / name, *(out / name).rglob("*")):
            refuse_link(path)
    from colmap_inertial.report.run_page import run_page

    target = out / "report.html"
    with reading(out, Fact("changed-records", names=("result.json", "diagnosis.json", "config.toml", "report_data"))):
        content = printable_values(gather(out, result=result, stopped=stopped, capture=capture))
        page = run_page(content, out)
        write_json(out / "report.json", content, indent=None)
    write_text(target, page)
    return target


def require_plotly() -> None:
    """Say at once that the report cannot be drawn, not after hours of mapping.

    Raises
    ------
    InertialError
    """
    if find_spec("plotly") is None:
        raise InertialError(Fact("plotly-missing"))


__all__ = ["require_plotly", "write_report"]

"""Whether a model that was mapped with a global shutter has images of a rolling one, by its own observations.

A readout that is not modelled bends a model: each image is stretched by how fast it moves, and scale follows. A few
steps of the refinement with the readout as an unknown tell it, each line at its own instant by the IMU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraModel, FrameTiming, ImuRecording, ReadoutDirection, ScaleEstimate
from colmap_inertial.inertial.refine._residuals import camera_of, derivatives, project
from colmap_inertial.inertial.refine.pictures import (
    apply_noise,
    measure_image_noise,
    pictures_alone,
    remove_extremes,
    select_points,
)
from colmap_inertial.inertial.refine.setup import Known, Seen, make_problem
from colmap_inertial.inertial.refine.solve import factor_information, solve
from colmap_inertial.inertial.refine.values import FIRST_INTRINSIC, READOUT, Estimate, FreeCamera, Problem
from colmap_inertial.inertial.scale.verdict import finite, half_width, verdict_of, without_width
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.shutter import compare_readout


@dataclass(frozen=True, kw_only=True)
class ShutterLimits:
    """Limits for finding a readout that was not declared."""

    #: It is one where it is longer, and so many standard deviations long.
    least_s: float = 1e-3
    sure_sigma: float = 3.0
    #: COLMAP leaves out observations that its global shutter misses by 4 px, and keeps those whose noise brings them
    #: nearer: found readouts are 2 to 10 % short, 5 % rms, and right with all observations
    #: (``scripts/studies/refine_real.py``).
    cut_share: float = 0.05
    #: Images in a row that are looked at: a readout is the camera's, not the recording's.
    most_images: int = 300
    #: Observations, at least, and about how many are looked at: more take longer and tell it no better than the model.
    fewest: int = 500
    most: int = 15_000
    #: Steps of the refinement: from a global shutter, three come within 3 to 11 % of 20 ms
    #: (``scripts/studies/refine_real.py``).
    steps: int = 3
    #: A declared readout is contradicted by one that is off by so many standard deviations, and by this; a declared
    #: focal length by one that is as surely another, and by this share.
    contradicts_sigmas: float = 5.0
    contradicts_s: float = 3e-3
    contradicts_focal: float = 0.03
    #: A declared camera without distortion is contradicted by one that as surely has some, and moves observations so
    #: far (root mean square).
    contradicts_lens_px: float = 1.0
    #: One that is found is followed on, so many times as far, until it moves by less than this share of its deviation.
    rounds: int = 5
    settled_sigma: float = 0.2
    #: Share by which the information is raised: points far away hardly have any along their rays.
    damping: float = 1e-6


SHUTTER_LIMITS = ShutterLimits()
#: The code of what is wrong with the scale of a model that ignores a rolling shutter.
SHUTTER_IGNORED = "rolling-shutter-ignored"


@dataclass(frozen=True, kw_only=True)
class SeenFocal:
    """Focal length of the camera with the most observations, by these.

    Attributes
    ----------
    model_px, found_px, sigma_px
        Of the model; by a few steps with the intrinsics free, and its standard deviation.
    """

    model_px: float
    found_px: float
    sigma_px: float

    @property
    def contradicts(self) -> bool:
        """Whether it is another than the model's, and by how much matters."""
        off_px = abs(self.found_px - self.model_px)
        limits = SHUTTER_LIMITS
        return off_px > max(limits.contradicts_focal * self.model_px, limits.contradicts_sigmas * self.sigma_px)

    def as_fact(self) -> Fact:
        """What is wrong with a model whose intrinsics were declared."""
        return Fact("declared-focal-length", declared_px=self.model_px, found_px=self.found_px, sigma_px=self.sigma_px)


#: Camera models without distortion, and those that add some to their numbers.
_DISTORTED = {"SIMPLE_PINHOLE": ("RADIAL", (0.0, 0.0)), "PINHOLE": ("OPENCV", (0.0, 0.0, 0.0, 0.0))}
#: Places across and down an image, at which distortion is looked at.
_PLACES = (32, 18)


@dataclass(frozen=True, kw_only=True)
class SeenLens:
    """Distortion of a camera whose model has none, by the observations.

    Attributes
    ----------
    declared
        Its model.
    found
        The camera with distortion, by a few steps with the intrinsics free.
    sigmas
        How many standard deviations its distortion is from none.
    shift_px
        How far it moves observations, root mean square over the image.
    """

    declared: str
    found: CameraModel
    sigmas: float
    shift_px: float

    @property
    def contradicts(self) -> bool:
        """Whether the camera has distortion, and by how much matters."""
        limits = SHUTTER_LIMITS
        return self.sigmas > limits.contradicts_sigmas and self.shift_px > limits.contradicts_lens_px

    def as_fact(self) -> Fact:
        """What is wrong with a model whose camera was declared without distortion."""
        extra = colmap_camera(self.found).extra_params_idxs()
        return Fact(
            "declared-distortion",
            declared=self.declared,
            found=self.found.model,
            distortion=[self.found.params[i] for i in extra],
            shift_px=self.shift_px,
        )


@dataclass(frozen=True, kw_only=True)
class SeenReadout:
    """Readout by the observations of a model.

    Attributes
    ----------
    readout_s, sigma_s
        From the first line to one past the last, and its standard deviation.
    direction
        Where the exposed line moves in the stored image.
    rate_hz
        How fast images move, in focal lengths, root mean square of their medians: times the readout, what they are
        stretched by.
    focal
        What was found of the camera on the way; ``None`` where its intrinsics were not free.
    lens
        Distortion, where it was looked for in a camera without.
    """

    readout_s: float
    sigma_s: float
    direction: ReadoutDirection
    rate_hz: float
    focal: SeenFocal | None = None
    lens: SeenLens | None = None

    @property
    def is_found(self) -> bool:
        """Whether lines were exposed one after the other, as surely as the refinement asks for."""
        return self.readout_s >= max(SHUTTER_LIMITS.least_s, SHUTTER_LIMITS.sure_sigma * self.sigma_s)

    def compared(self, declared: FrameTiming) -> Fact | None:
        """A declared readout that it contradicts; ``None`` where they agree."""
        limits = SHUTTER_LIMITS
        return compare_readout(
            declared,
            self.readout_s,
            self.sigma_s,
            self.direction,
            least_s=limits.contradicts_s,
            sigmas=limits.contradicts_sigmas,
        )

    def as_fact(self, *, declared_global: bool = False) -> Fact:
        """What is wrong with the model's scale then."""
        declared = {"declared_global": True} if declared_global else {}
        return Fact(
            SHUTTER_IGNORED, readout_s=self.readout_s, sigma_s=self.sigma_s, direction=self.direction, **declared
        )

    def _unknown(self, sigma_log: float) -> Fact:
        """Why a scale is refused that a shutter leaves open."""
        longest_s = self.readout_s + 2 * self.sigma_s
        return Fact("rolling-shutter-possible", readout_s=longest_s, half_width=finite(half_width(sigma_log)))

    def widen(self, estimate: ScaleEstimate, *, declared_global: bool = False) -> ScaleEstimate:
        """A scale as uncertain as such a shutter makes it; weak where it was found, as the refinement takes it in."""
        assert estimate.parts is not None and estimate.cov is not None
        accepted = estimate.accepted
        sigma = float(np.hypot(self.readout_s, self.sigma_s)) * self.rate_hz
        doubts = without_width(estimate.reasons)
        if self.is_found:
            doubts.append(self.as_fact(declared_global=declared_global))
        sigma_log = float(np.hypot(accepted.sigma_log, sigma))
        verdict, ci95, reasons = verdict_of(accepted.metres_per_unit, sigma_log, doubts)
        if verdict == "refused":
            if not self.is_found:
                return ScaleEstimate.refused(estimate.method, self._unknown(sigma), calibration=estimate.calibration)
            verdict, reasons = "weak", tuple(doubts)
        cov = estimate.cov.copy()
        cov[0, 0] = sigma_log**2
        return replace(
            estimate,
            sigma_log=sigma_log,
            ci95=ci95,
            verdict=verdict,
            reasons=reasons,
            cov=cov,
            parts={**estimate.parts, "rolling_shutter": sigma},
        )


def find_readout(
    seen: Seen,
    timing: FrameTiming,
    imu: ImuRecording,
    known: Known,
    *,
    exposed_px: Callable[[Seen], Array] | None = None,
    find_lens: bool = False,
) -> SeenReadout | None:
    """The readout of a metric model's images, down or across, whatever is declared; ``None`` where too little is seen.

    Of rectified keypoints, along what is declared, from which the model was made.

    Parameters
    ----------
    seen
        The model, or a part of it.
    timing, imu, known
        As the refinement has them.
    exposed_px
        Where the shutter had the observations of a model whose keypoints were rectified.
    find_lens
        Whether cameras without distortion may have some.

    Raises
    ------
    NotObservableError
        Where the IMU recorded hardly any of the frames.
    numpy.linalg.LinAlgError
        Where nothing determines it.
    """
    seen = remove_extremes(seen)
    count = len(seen.observations.frame)
    if count < SHUTTER_LIMITS.fewest:
        return None
    seen = select_points(seen, np.arange(len(seen.points)) % -(-count // SHUTTER_LIMITS.most) == 0)
    if find_lens:
        seen = replace(seen, cameras=tuple(map(_add_distortion, seen.cameras)))
    if exposed_px is not None:
        return _measure(seen, timing, imu, known, exposed_px(seen), rounds=SHUTTER_LIMITS.rounds)
    at_once_px = seen.observations.xy_px
    directions: tuple[ReadoutDirection, ...] = ("down", "right")
    found = [
        _measure(seen, replace(timing, readout_s=None, readout_direction=direction), imu, known, at_once_px)
        for direction in directions
    ]
    likelier = max(found, key=lambda one: one.readout_s / one.sigma_s)
    if not likelier.is_found:
        return likelier
    timing = replace(timing, readout_s=None, readout_direction=likelier.direction)
    return _measure(seen, timing, imu, known, at_once_px, rounds=SHUTTER_LIMITS.rounds)


_OPPOSITE: dict[ReadoutDirection, ReadoutDirection] = {"down": "up", "up": "down", "right": "left", "left": "right"}


def _measure(
    seen: Seen, timing: FrameTiming, imu: ImuRecording, known: Known, exposed_px: Array, rounds: int = 1
) -> SeenReadout:
    """The readout with lines that run as the timing says, or the other way."""
    problem, start = make_problem(seen, timing, imu, known, exposed_px)
    problem = apply_noise(problem, measure_image_noise(pictures_alone(problem, seen.observations.xy_px), start))
    x = start
    for _ in range(rounds):
        before_s = x.readout_s
        x = solve(problem, x, most_steps=SHUTTER_LIMITS.steps).estimate
        cov = factor_information(problem, x, damping=SHUTTER_LIMITS.damping).shared_cov()
        variance = float(cov[READOUT, READOUT])
        if abs(x.readout_s - before_s) < SHUTTER_LIMITS.settled_sigma * variance**0.5:
            break
    observations = problem.observations
    alike = np.ones(len(observations.frame))
    by = derivatives(problem, x, observations, project(problem, x, observations), alike).by_shared[:, :, READOUT]
    # an observation moves by its line's share of the readout
    away = np.flatnonzero(observations.line)
    speed_px_s = np.linalg.norm(by[away], axis=1) / np.abs(observations.line[away])
    frame = observations.frame[away]
    of_images = [float(np.median(speed_px_s[frame == i])) for i in np.unique(frame)]
    focal_px = float(np.mean([colmap_camera(camera).mean_focal_length() for camera in seen.cameras]))
    return SeenReadout(
        readout_s=abs(x.readout_s),
        sigma_s=float(np.hypot(variance**0.5, SHUTTER_LIMITS.cut_share * x.readout_s)),
        direction=timing.readout_direction if x.readout_s >= 0 else _OPPOSITE[timing.readout_direction],
        rate_hz=float(np.sqrt(np.mean(np.square(of_images)))) / focal_px,
        focal=_focal_of(problem, start, x, cov),
        lens=_lens_of(problem, x, cov),
    )


def _add_distortion(camera: CameraModel) -> CameraModel:
    """A camera as it is, of a model that has distortion."""
    if camera.model not in _DISTORTED:
        return camera
    model, none = _DISTORTED[camera.model]
    return replace(camera, model=model, params=(*camera.params, *none))


def _find_most_seen(problem: Problem) -> tuple[FreeCamera, int]:
    """The camera with the most observations, and the place of its first free number among those of all cameras."""
    of_camera = np.bincount(problem.camera_of[problem.observations.frame], minlength=len(problem.cameras))
    number = int(np.argmax(of_camera))
    return problem.cameras[number], sum(len(camera.free) for camera in problem.cameras[:number])


def _lens_of(problem: Problem, x: Estimate, cov: Array) -> SeenLens | None:
    """Distortion of the camera with the most observations; ``None`` where it began with some, or cannot have any."""
    camera, before = _find_most_seen(problem)
    extra = list(colmap_camera(camera.model).extra_params_idxs())
    declared = next((plain for plain, (distorted, _) in _DISTORTED.items() if distorted == camera.model.model), None)
    if declared is None or not camera.free or np.any(np.array(camera.model.params)[extra]):
        return None
    at = FIRST_INTRINSIC + before + np.array([camera.free.index(place) for place in extra])
    found = camera_of(camera, x.intrinsics[before : before + len(camera.free)])
    none = replace(found, params=tuple(0.0 if i in extra else value for i, value in enumerate(found.params)))
    across, down = np.meshgrid(*((np.arange(n) + 0.5) / n for n in _PLACES))
    places = np.stack([across.ravel() * found.width, down.ravel() * found.height], axis=1)
    rays = np.column_stack([np.asarray(colmap_camera(none).cam_from_img(places)), np.ones(len(places))])
    shift = np.asarray(colmap_camera(found).img_from_cam(rays)) - places
    distortion = x.intrinsics[at - FIRST_INTRINSIC]
    return SeenLens(
        declared=declared,
        found=found,
        sigmas=float(distortion @ np.linalg.solve(cov[np.ix_(at, at)], distortion)) ** 0.5,
        shift_px=float(np.sqrt(np.mean(np.sum(shift**2, axis=1)))),
    )


def _focal_of(problem: Problem, start: Estimate, x: Estimate, cov: Array) -> SeenFocal | None:
    """Mean focal length of the camera with the most observations."""
    camera, before = _find_most_seen(problem)
    focal = [i for i, place in enumerate(camera.free) if place in colmap_camera(camera.model).focal_length_idxs()]
    if not focal:
        return None
    at = before + np.array(focal)
    mean = np.zeros(len(cov))
    mean[FIRST_INTRINSIC + at] = 1 / len(at)
    return SeenFocal(
        model_px=float(start.intrinsics[at].mean()),
        found_px=float(x.intrinsics[at].mean()),
        sigma_px=float(mean @ cov @ mean) ** 0.5,
    )

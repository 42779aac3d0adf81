"""Metric models on the map: the positions that a capture carries, met with where its frames were taken."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_inertial.core.errors import NotObservableError, TargetNotFoundError
from colmap_inertial.core.options import WorldAxes
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import DOWN_IN_WORLD, FrameTiming, PositionFixes
from colmap_inertial.evidence.positions import georeference_path
from colmap_inertial.inertial.georeference import Georeference
from colmap_inertial.io.files import read_record, write_json, write_record
from colmap_inertial.model import read_model, trajectory_from_model
from colmap_inertial.run.commands.outcome import Outcome
from colmap_inertial.run.commands.result import ModelResult, error_as_json
from colmap_inertial.run.preparation.geolocation import cameras_as_json
from colmap_inertial.run.steps.session import Session

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Outcomes:
    """Outcomes of all metric models by their numbers; the reason where a heading stays open."""

    models: dict[str, Outcome[Georeference]]


def run_georeference(
    session: Session,
    models: Sequence[ModelResult],
    fixes: PositionFixes | None,
    timing: FrameTiming,
    world: WorldAxes,
) -> tuple[ModelResult, ...]:
    """Metric models with their place on Earth, where positions were asked for; ``georeference.json`` holds it."""
    workspace = session.workspace
    if fixes is None:
        session.runner.discard(workspace.georeference)
        return tuple(models)
    metric = {model.index: model.sparse_metric for model in models if model.sparse_metric is not None}
    record = workspace.stamps / "georeferenced.json"

    def work(partial: Sequence[Path]) -> None:
        outcomes: dict[str, Outcome[Georeference]] = {}
        written: list[dict[str, object]] = []
        for index, folder in metric.items():
            path, _ = trajectory_from_model(read_model(folder), timing, covariances=False)
            try:
                georeference = georeference_path(fixes, path, -DOWN_IN_WORLD[world])
            except NotObservableError as error:
                outcomes[str(index)] = Outcome.of_error(error)
                written.append({"model": index, **error_as_json(error)})
            else:
                outcomes[str(index)] = Outcome(found=georeference)
                written.append(
                    {
                        "model": index,
                        **georeference.as_json(),
                        "cameras": cameras_as_json(georeference, path.names, path.cam_in_world),
                    }
                )
        write_record(partial[0], _Outcomes(models=outcomes))
        write_json(partial[1], {"models": written})

    depends = {"fixes": fixes, "timing": timing, "world": world}
    session.runner.run("georeference", depends, [record, workspace.georeference], work, after=("metric",))
    known: dict[int, Georeference | NotObservableError] = {}
    for number, entry in read_record(record, _Outcomes).models.items():
        index, outcome = int(number), entry.result()
        assert not isinstance(outcome, TargetNotFoundError)
        known[index] = outcome
        if isinstance(outcome, Georeference):
            width_deg = Z95 * outcome.heading_sigma_deg
            log.info("model %d: heading +-%.1f degrees by %d positions", index, width_deg, outcome.used)
        else:
            log.info("model %d: %s", index, outcome)
    return tuple(replace(model, georeference=known.get(model.index)) for model in models)

"""Parts of torn models on their way through a stage that joins models.

A model is torn where all cameras after some image are turned against those before. Its largest part goes on as the
model; each other part becomes a model of its own, with a free number, so that the stage may join it again.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Action, RotationConsensus, Treatment
from colmap_inertial.model import Model
from colmap_inertial.model.deregistration import deregister_images
from colmap_inertial.motion.align.consensus import describe_consensus, without_consensus

log = logging.getLogger(__name__)

#: The code of what the stages said of a model's cameras.
_JUDGED = "cameras-judged"


class TornParts:
    """Smaller parts of torn models, each a model by itself; those that are not joined stay left out.

    Parameters
    ----------
    first
        The first number that no model has.
    """

    def __init__(self, first: int) -> None:
        self._next = first
        self._torn_off: dict[int, int] = {}  # the number of the model that a part was torn off, by the part's number
        self._names: dict[int, tuple[str, ...]] = {}  # of a part's images

    def __bool__(self) -> bool:
        return bool(self._torn_off)

    def split(self, model: Model, staged: Model) -> Iterator[Model]:
        """Make models of the smaller parts of a torn one.

        Parameters
        ----------
        model
            As COLMAP made it.
        staged
            The same after the stages, which names the images of its smaller parts.
        """
        images = {model.reconstruction.image(number).name for number in model.reconstruction.reg_image_ids()}
        for names in staged.torn_off:
            number, self._next = self._next, self._next + 1
            self._torn_off[number], self._names[number] = model.colmap_index, names
            log.info("%d images that were torn off model %d are model %d", len(names), model.colmap_index, number)
            part = deregister_images(model.reconstruction, images - set(names))
            yield replace(model, reconstruction=part, colmap_index=number)

    def describe_joined(self, models: Sequence[Model]) -> list[Model]:
        """Leave out parts that stayed apart; where a model got its own parts back, have it say so."""
        return [
            self._describe_regained(model)
            for model in models
            if model.parts or model.colmap_index not in self._torn_off
        ]

    def _describe_regained(self, model: Model) -> Model:
        """A joined model whose cameras are judged anew, with the parts that were torn off it and are back."""
        own = [p.colmap_index for p in model.parts if self._torn_off.get(p.colmap_index) == model.colmap_index]
        names = tuple(name for number in own for name in self._names[number])
        if not names or model.rotations is None or model.scale is None:
            return model
        rotations = replace(model.rotations, joined=names)
        notes = (*without_consensus(model.scale.notes), *describe_consensus(rotations))
        return replace(
            model,
            rotations=rotations,
            scale=replace(model.scale, rotations=rotations, notes=notes),
            treatments=tuple(
                _judge_again(treatment, rotations) if treatment.reason.code == _JUDGED else treatment
                for treatment in model.treatments
            ),
        )


def _judge_again(treatment: Treatment, rotations: RotationConsensus) -> Treatment:
    """The stages' record of a model's cameras, as these are judged now."""
    other_facts = without_consensus(treatment.reason.values["facts"])
    return Treatment(
        stage=treatment.stage,
        reason=Fact(_JUDGED, facts=(*describe_consensus(rotations), *other_facts)),
        action=Action.LEFT_OUT if rotations.left_out else Action.JOINED,
        values={**treatment.values, "left_out": rotations.left_out},
    )

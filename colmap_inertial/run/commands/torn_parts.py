"""Parts of torn models on their way through a stage that joins models."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import Action, Treatment
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
        self._images: dict[int, tuple[int, tuple[str, ...]]] = {}

    def __bool__(self) -> bool:
        return bool(self._images)

    def split(self, before: Model, made: Model) -> Iterator[Model]:
        """The smaller parts of a model as COLMAP made it; ``made`` is what the stages made of it, and names them."""
        images = [before.reconstruction.image(number).name for number in before.reconstruction.reg_image_ids()]
        for names in made.torn_off:
            number, self._next = self._next, self._next + 1
            self._images[number] = before.colmap_index, names
            log.info("%d images that were torn off model %d are model %d", len(names), before.colmap_index, number)
            part = deregister_images(before.reconstruction, set(images) - set(names))
            yield replace(before, reconstruction=part, colmap_index=number)

    def describe_joined(self, models: Sequence[Model]) -> list[Model]:
        """Models without parts that stayed apart; where a model got its own parts back, it says so."""
        return [self._describe(model) for model in models if model.parts or model.colmap_index not in self._images]

    def _describe(self, model: Model) -> Model:
        before, scale = model.rotations, model.scale
        back = [self._images.get(part.colmap_index) for part in model.parts]
        names = tuple(name for one in back if one and one[0] == model.colmap_index for name in one[1])
        if not names or before is None or scale is None:
            return model
        now = replace(before, joined=names)
        description = describe_consensus(now)
        treatments = (
            Treatment(
                stage=done.stage,
                reason=Fact(_JUDGED, facts=(*description, *without_consensus(done.reason.values["facts"]))),
                action=Action.LEFT_OUT if now.left_out else Action.JOINED,
                values={**done.values, "left_out": now.left_out},
            )
            if done.reason.code == _JUDGED
            else done
            for done in model.treatments
        )
        notes = (*without_consensus(scale.notes), *description)
        return replace(
            model, rotations=now, scale=replace(scale, rotations=now, notes=notes), treatments=tuple(treatments)
        )

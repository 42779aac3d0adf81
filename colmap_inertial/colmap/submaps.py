"""Captures too long for one go: mapped in parts that overlap, which then become one model.

COLMAP adjusts the whole model again and again while it grows, and from 1000 images on by conjugate gradients, which
along a chain of images hardly move. Parts take as long for each image in a capture of any length.
What they have in common, images and matches between them, says how each lies in the next: together, and with the loops
that matching closed, that places all of them. Then their points are made one, and the whole is adjusted. What does not
fit then is forgotten, the worst first, and the rest is placed and adjusted again.
"""

from __future__ import annotations

import copy
import itertools
import logging
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.colmap.loop_closure import LoopClosure, SubmapOverlap, merge_overlaps
from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.model.observed import points_of_features

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Two parts that meet, or one that meets itself: their places, the smaller one first.
Seam = tuple[int, int]

#: Images of a part at most, and of these, how many the next one has, too.
PART, SHARED = 400, 40
#: Parts lie beside each other where so many points are known to be the same: as many matches as COLMAP asks of views.
LEAST_SAME = 15
#: Places of a point in two parts differ by this share of how far away it is from the camera, or it is not the same.
_SAME_SHARE = 0.1
#: So many of the images are in what parts become, or they stay apart: what only its part's seam held may go.
_LEAST_KEPT = 0.99
#: Of a pair of parts, so many points are plenty to place them by.
_PLENTY = 500


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedRun:
    """A model of a run of the images, or of some of it; a part of the whole.

    Attributes
    ----------
    model
        COLMAP's.
    begin, end
        The images that it was made from, by their places in time: the first one, and the first one beyond.
    """

    model: pycolmap.Reconstruction
    begin: int
    end: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Tie:
    """Points that two parts have both.

    Attributes
    ----------
    first, second
        Places of the parts.
    in_first, in_second
        (K, 3) the points, in the parts' own units.
    away
        (K,) how far from the cameras they are, in the first one's units.
    similar
        From the second one to the first one.
    """

    first: int
    second: int
    in_first: Array
    in_second: Array
    away: Array
    similar: pycolmap.Sim3d


def moved(similar: pycolmap.Sim3d, step: Array) -> pycolmap.Sim3d:
    """By (7,) logarithm of the scale, rotation vector, translation, all small."""
    import pycolmap

    return pycolmap.Sim3d(
        similar.scale * float(np.exp(step[0])),
        pycolmap.Rotation3d(so3_exp(step[1:4]) @ similar.rotation.matrix()),
        similar.translation + step[4:],
    )


def runs(count: int, *, longest: int = PART, shared: int = SHARED) -> list[tuple[int, int]]:
    """Begins and ends of few runs, about equally long, that hold so many images; neighbours share some."""
    parts = max(1, -(-(count - shared) // (longest - shared)))
    begins = np.round(np.arange(parts + 1) * (count - shared) / parts).astype(int).tolist()
    return [(begin, min(count, end + shared)) for begin, end in itertools.pairwise(begins)]


def map_in_parts(
    database: Path,
    images: Path,
    sparse: Path,
    pipeline: pycolmap.IncrementalPipelineOptions,
    names: Sequence[str],
    parts: Sequence[tuple[int, int]],
    *,
    near: int,
    loops: bool,
    registered: Callable[[], None],
) -> tuple[list[pycolmap.Reconstruction], list[LoopClosure]]:
    """Run COLMAP's incremental mapper on runs of the images, and join what comes out; the largest model first.

    Parameters
    ----------
    sparse
        Where models go; the parts' own are for a while in folders inside.
    names
        In order of time.
    parts
        Begins and ends, as :func:`runs` has them.
    near
        Images no farther apart in time are neighbours.
    loops
        Whether matches of others may be believed; else they may join copies, and are not looked at.
    registered
        Is called for each image that a part places.

    Returns
    -------
    The models, and where parts met.
    """
    import pycolmap

    made = []
    own = copy.copy(pipeline)
    own.extract_colors = False
    for begin, end in parts:
        own.image_names = list(names[begin:end])
        with tempfile.TemporaryDirectory(dir=sparse) as folder:
            models = pycolmap.incremental_mapping(
                str(database), str(images), folder, options=own, next_image_callback=registered
            )
        made += [MappedRun(model=model, begin=begin, end=end) for _, model in sorted(models.items())]
    joined, seams = join_runs(database, made, pipeline, names, near=near, loops=loops) if made else ([], [])
    return sorted(joined, key=lambda model: -int(model.num_reg_images())), seams


def join_runs(
    database: Path,
    parts: Sequence[MappedRun],
    pipeline: pycolmap.IncrementalPipelineOptions,
    names: Sequence[str],
    *,
    near: int,
    loops: bool,
) -> tuple[list[pycolmap.Reconstruction], list[LoopClosure]]:
    """Of parts that lie beside each other, one model, and the seams between them, those that did not fit, too.

    Of a seam that does not fit, first loops are not believed, then nothing is: its tie places no part, and its matches
    make no points one. Each time one seam is less, so that it ends; at worst, parts stay as they are.
    """
    ties = {(tie.first, tie.second): tie for tie in find_ties(database, parts, names, nearest=None if loops else near)}
    nearby: dict[Seam, Tie] | None = None
    nearest: dict[Seam, int | None] = dict.fromkeys(ties, None if loops else near)
    nearest |= {(k, k): None if loops else near for k in range(len(parts))}
    joined: list[pycolmap.Reconstruction] = []
    seams: list[LoopClosure] = []
    waiting = _groups(range(len(parts)), ties)
    while waiting:
        members = waiting.pop(0)
        if len(members) == 1:
            joined.append(parts[members[0]].model)
            continue
        own = [tie for seam, tie in ties.items() if seam[0] in members]
        placed = place_parts(members, own)
        whole, part_of = _whole(database, [parts[k] for k in members], placed, pipeline, names)
        of_group = {number: members[k] for number, k in part_of.items()}
        met = merge_overlaps(database, whole, pipeline, names, part_of=of_group, nearest=nearest)
        hold = [seam for seam, one in met.seams.items() if one.joined]
        whole_again = len(_groups(members, hold)) == 1
        if len(hold) == len(met.seams) and whole_again and met.kept >= _LEAST_KEPT:
            joined.append(whole)
            seams += met.seams.values()
            continue
        worst = _worst(met, own, dict(zip(members, placed, strict=True)))
        said = met.seams.get(worst)
        if said is not None:
            seams.append(replace(said, joined=False))
        log.info("parts %d and %d do not fit (%.0f %% agree)", *worst, 100 * (said.agree if said else 0))
        ties.pop(worst, None)
        limit = nearest.pop(worst)
        if limit is None and met.farthest.get(worst, 0) > near:
            if nearby is None:
                nearby = {(tie.first, tie.second): tie for tie in find_ties(database, parts, names, nearest=near)}
            if worst in nearby:
                ties[worst] = nearby[worst]
            if worst in nearby or worst[0] == worst[1]:
                nearest[worst] = near
        waiting = _groups(members, ties) + waiting
    return joined, seams


def _worst(met: SubmapOverlap, ties: Sequence[Tie], placed: Mapping[int, pycolmap.Sim3d]) -> Seam:
    """The seam that fits least once all was adjusted; where that does not tell, the tie that parts lie by least."""

    def fits(tie: Tie) -> tuple[float, int]:
        second_in_first = placed[tie.first].inverse() * placed[tie.second]
        off = np.linalg.norm(tie.in_first - second_in_first * tie.in_second, axis=1)
        return float(np.mean(off < _SAME_SHARE * tie.away)), len(tie.away)

    fit = {(tie.first, tie.second): fits(tie) for tie in ties}
    if all(one.joined for one in met.seams.values()) and (unseen := fit.keys() - met.seams.keys()):
        return min(unseen, key=lambda seam: (fit[seam], seam))
    # points are no fewer than so many of a seam inside of a part, which nothing places
    return min(met.seams, key=lambda seam: (met.seams[seam].agree, fit.get(seam, (1.0, _PLENTY)), seam))


def find_ties(database: Path, parts: Sequence[MappedRun], names: Sequence[str], *, nearest: int | None) -> list[Tie]:
    """What parts have in common: points of images that both have, or else of images that are matched."""
    import pycolmap

    place = {name: at for at, name in enumerate(names)}
    points = [
        {number: points_of_features(part.model.image(number)) for number in part.model.reg_image_ids()}
        for part in parts
    ]
    having: dict[int, list[int]] = {}
    for k, of_images in enumerate(points):
        for number in of_images:
            having.setdefault(number, []).append(k)
    same: dict[tuple[int, int], list[tuple[int, Int64Array]]] = {}

    def add(a: int, b: int, image: int, of_a: Int64Array, of_b: Int64Array) -> None:
        both = (of_a >= 0) & (of_b >= 0)
        same.setdefault((a, b), []).append((image, np.stack([of_a[both], of_b[both]], axis=1)))

    for number, holders in sorted(having.items()):
        for a, b in itertools.combinations(holders, 2):
            add(a, b, number, points[a][number], points[b][number])
    beside = set(same)
    with pycolmap.Database.open(str(database)) as opened:
        for pair, count in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            i, j = pycolmap.pair_id_to_image_pair(pair)
            if count < LEAST_SAME or i not in having or j not in having:
                continue
            across = [(a, b) for a in having[i] for b in having[j] if a != b and tuple(sorted((a, b))) not in beside]
            apart = abs(place[parts[having[i][0]].model.image(i).name] - place[parts[having[j][0]].model.image(j).name])
            if not across or (nearest is not None and apart > nearest):
                continue
            matches = np.array(opened.read_two_view_geometry(i, j).inlier_matches, dtype=np.int64)
            for a, b in across:
                if a < b:
                    add(a, b, i, points[a][i][matches[:, 0]], points[b][j][matches[:, 1]])
                else:
                    add(b, a, j, points[b][j][matches[:, 1]], points[a][i][matches[:, 0]])
    found = (_tie(parts, a, b, seen) for (a, b), seen in sorted(same.items()))
    return [tie for tie in found if tie is not None]


def _tie(parts: Sequence[MappedRun], a: int, b: int, seen: Sequence[tuple[int, Int64Array]]) -> Tie | None:
    """Points that two parts have both, without those that contradict the others; None where these are too few."""
    import pycolmap

    first, second = parts[a].model, parts[b].model
    pairs = np.concatenate([pairs for _, pairs in seen])
    images = np.repeat([image for image, _ in seen], [len(pairs) for _, pairs in seen])
    pairs, at = np.unique(pairs, axis=0, return_index=True)
    if len(pairs) < LEAST_SAME:
        return None
    centres = {int(image): first.image(image).projection_center() for image in np.unique(images[at])}
    in_first = np.array([first.point3D(number).xyz for number in pairs[:, 0].tolist()])
    in_second = np.array([second.point3D(number).xyz for number in pairs[:, 1].tolist()])
    away = np.linalg.norm(in_first - np.array([centres[image] for image in images[at].tolist()]), axis=1)
    ransac = pycolmap.RANSACOptions()
    ransac.random_seed = 0
    ransac.max_error = _SAME_SHARE * float(np.median(away))
    found: Any = pycolmap.estimate_sim3d_robust(in_second, in_first, ransac)  # a dict, whatever it is said to be
    if found is None:
        return None
    similar: pycolmap.Sim3d = found["tgt_from_src"]
    agree = np.flatnonzero(np.linalg.norm(in_first - similar * in_second, axis=1) < _SAME_SHARE * away)
    if len(agree) < max(LEAST_SAME, len(pairs) / 2):
        return None
    log.info("parts %d and %d: %d of %d points agree", a, b, len(agree), len(pairs))
    some = agree[np.linspace(0, len(agree) - 1, min(_PLENTY, len(agree))).astype(int)]
    return Tie(first=a, second=b, in_first=in_first[some], in_second=in_second[some], away=away[some], similar=similar)


def _groups(members: Sequence[int], seams: Iterable[Seam]) -> list[list[int]]:
    """Parts that hang together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    place = {k: at for at, k in enumerate(members)}
    ends = np.array([(place[a], place[b]) for a, b in seams if a in place], dtype=np.intp).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(place), len(place)))
    number, of_part = connected_components(graph, directed=False)
    return [[members[at] for at in np.flatnonzero(of_part == k).tolist()] for k in range(number)]


def place_parts(members: Sequence[int], ties: Sequence[Tie]) -> list[pycolmap.Sim3d]:
    """Where parts that hang together lie in the first one's world, by all ties at once."""
    import pycolmap
    from scipy.optimize import least_squares

    known = {members[0]: pycolmap.Sim3d()}
    for tie in itertools.chain.from_iterable(itertools.repeat(sorted(ties, key=lambda t: -len(t.away)), len(members))):
        if tie.first in known and tie.second not in known:
            known[tie.second] = known[tie.first] * tie.similar
        elif tie.second in known and tie.first not in known:
            known[tie.first] = known[tie.second] * tie.similar.inverse()
    if len(ties) < len(members):
        return [known[k] for k in members]
    place = {k: at for at, k in enumerate(members)}
    start = [known[k] for k in members]
    short = [_shortened(tie) for tie in ties]

    def at(x: Array) -> list[pycolmap.Sim3d]:
        steps = np.vstack([np.zeros(7), x.reshape(-1, 7)])
        return [moved(one, step) for one, step in zip(start, steps, strict=True)]

    def off(x: Array) -> Array:
        lie = at(x)
        out = []
        for tie, (design, target) in zip(ties, short, strict=True):
            second_in_first = lie[place[tie.first]].inverse() * lie[place[tie.second]]
            out.append(target - design @ second_in_first.matrix().T)
        return np.concatenate(out).ravel()

    return at(least_squares(off, np.zeros(7 * (len(members) - 1)), x_scale="jac").x)


def _shortened(tie: Tie) -> tuple[Array, Array]:
    """(4, 4) and (4, 3): what is left of all of a tie's points, but for a sum of squares that nothing changes.

    Over their distances, places in the first part less those in the second, moved, are linear in the twelve numbers
    that move them. So as many rows as these have for each coordinate say as much as all points.
    """
    design = np.c_[tie.in_second, np.ones(len(tie.away))]
    _, upper = np.linalg.qr(np.c_[design, tie.in_first] / tie.away[:, None])
    return np.asarray(upper[:4, :4]), np.asarray(upper[:4, 4:])


def _whole(
    database: Path,
    group: Sequence[MappedRun],
    placed: Sequence[pycolmap.Sim3d],
    pipeline: pycolmap.IncrementalPipelineOptions,
    names: Sequence[str],
) -> tuple[pycolmap.Reconstruction, dict[int, int]]:
    """One model of parts, and by number of an image whose it is: of several, that has most images on both sides."""
    import pycolmap

    place = {name: at for at, name in enumerate(names)}
    owner: dict[int, tuple[int, int]] = {}
    for k, part in enumerate(group):
        for number in part.model.reg_image_ids():
            at = place[part.model.image(number).name]
            inside = min(at - part.begin, part.end - 1 - at)
            if number not in owner or inside > owner[number][0]:
                owner[number] = (inside, k)
    cached = pycolmap.DatabaseCacheOptions()
    cached.min_num_matches = pipeline.min_num_matches
    whole = pycolmap.Reconstruction()
    with pycolmap.Database.open(str(database)) as opened:
        whole.load(pycolmap.DatabaseCache.create(opened, cached))
    # each part refined its own cameras, where they are refined
    for part in sorted(group, key=lambda part: int(part.model.compute_num_observations())):
        for camera_id, camera in part.model.cameras.items():
            whole.camera(camera_id).params = list(camera.params)
    for k, (part, similar) in enumerate(zip(group, placed, strict=True)):
        model = pycolmap.Reconstruction(part.model)
        model.transform(similar)
        own = {number for number in model.reg_image_ids() if owner[number][1] == k}
        for number in sorted(own):
            image = model.image(number)
            whole.frame(image.frame_id).set_cam_from_world(image.camera_id, image.cam_from_world())
            whole.register_frame(image.frame_id)
        for _, point in sorted(model.points3D.items()):
            elements = [element for element in point.track.elements if element.image_id in own]
            if len(elements) > 1:
                whole.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    return whole, {number: k for number, (_, k) in owner.items()}

"""Pages: single files that need nothing else, from the templates beside this module.

Templates escape whatever they are given (``autoescape``): names and messages come from strangers.
"""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_inertial.inertial.scale.verdict import TRUSTED_HALF_WIDTH, WEAK_HALF_WIDTH
from colmap_inertial.io.files import path_in, read_bytes
from colmap_inertial.io.images import require_modest
from colmap_inertial.report.figures import Figure
from colmap_inertial.report.series import SIZES
from colmap_inertial.report.still import draw_still
from colmap_inertial.report.still_3d import StillView, draw_scene_still
from colmap_inertial.report.words import digits, signed

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

_UNIT = re.compile(r"(\d) ((?:m|cm|mm|s|ms|px|Hz|m/s²|°/s|rad/s)\b|%)")
_CODE = re.compile("`([^`]+)`")
_MINUS = re.compile(r"(?<![^\s(])-(?=\d+\.\d)")
#: Images are embedded no wider than this, as JPEG of this quality.
_IMAGE = {"width_px": 720, "jpeg_quality": 78}


def render_page(template: str, *, out: Path | None = None, **values: Any) -> str:
    """A page as HTML.

    Parameters
    ----------
    template
        Name of its template.
    out
        Folder that paths of its images start from.
    values
        What the template shows; of every page ``title``, ``source``, ``footer`` and ``tone``, which colours it
        (``"trusted"``, ``"weak"``, ``"refused"`` or ``"stopped"``).

    Raises
    ------
    LookupError
        Where the template names what is not in the values.
    """
    from jinja2 import UndefinedError
    from markupsafe import Markup

    figures: dict[str, Figure] = {}
    links: list[tuple[str, str]] = []

    def plot(figure: Figure, label: str) -> Markup:
        """A place for a figure, and its still image; ``label`` is for those who cannot see it."""
        key = f"f{len(figures)}"
        figures[key] = figure
        place = '<div class="plot" data-figure="{}" role="img" aria-label="{}"></div>'
        is_scene = "scene" in figure["layout"]
        still = draw_scene_still(figure, label, StillView.from_above()) if is_scene else draw_still(figure, label)
        return Markup(place).format(key, label) + Markup(still)

    def picture(figure: Figure, label: str) -> Markup:
        """The model as it looks, for the first screen."""
        return Markup(draw_scene_still(figure, label))

    def add_link(anchor: str, short: str) -> str:
        """Note a section for the list of links, where it has a name there."""
        if short:
            links.append((anchor, short))
        return ""

    def embed(paths: Sequence[str], captions: Sequence[str] | None = None) -> list[tuple[str, str]]:
        return [] if out is None else embed_images(out, paths, captions)

    def thumbnail(path: str | None) -> str | None:
        """Data URL of a small image; ``None`` where there is none."""
        return None if out is None or path is None else _data_url(path_in(out, path), SIZES.thumbnail_px)

    shared = {
        "plot": plot,
        "picture": picture,
        "add_link": add_link,
        "embedded": embed,
        "thumbnail": thumbnail,
        "figures_drawn": figures,
        "links": links,
    }
    try:
        return _environment().get_template(template).render(**values, **shared)
    except UndefinedError as error:
        raise LookupError(str(error)) from error


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("colmap_inertial.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "prose": prose,
        "sentence": sentence,
        "digits": digits,
        "signed": signed,
        "degrees": math.degrees,
        "packed_json": _pack_json,
    }
    environment.globals |= {
        "library": _plotly_library,
        "gauge_at": _gauge_at,
        "trusted_pct": 100 * TRUSTED_HALF_WIDTH,
        "weak_pct": 100 * WEAK_HALF_WIDTH,
    }
    return environment


def prose(text: str) -> Markup:
    """Text for a paragraph: escaped, signs and `code` set in type, numbers kept on one line with their units."""
    from markupsafe import Markup, escape

    signs = text.replace("m/s2", "m/s²").replace("+-", "±").replace(" x ", " × ").replace(" degrees", "°")
    typeset = escape(_MINUS.sub("−", signs))
    return Markup(_CODE.sub("<code>\\1</code>", _UNIT.sub("\\1\N{NO-BREAK SPACE}\\2", typeset)))


def sentence(text: str) -> Markup:
    """The same, with a capital letter and a full stop."""
    text = text.strip()
    return prose(text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else "."))


def _gauge_at(pct: float) -> float:
    """Position of a half-width on the gauge (10 to 490): from 0.1 % to 100 %."""
    return 10.0 + 480.0 * (min(max(math.log10(max(pct, 1e-9)), -1.0), 2.0) + 1) / 3


def embed_images(out: Path, paths: Sequence[str], captions: Sequence[str] | None = None) -> list[tuple[str, str]]:
    """Caption (by default the file's name) and data URL of each image; those that are gone are left out."""
    named = zip(captions or [Path(path).stem for path in paths], paths, strict=True)
    embedded = ((caption, _data_url(path_in(out, path))) for caption, path in named)
    return [(caption, url) for caption, url in embedded if url is not None]


def _data_url(path: Path, widest_px: int = _IMAGE["width_px"]) -> str | None:
    """Data URL of an image, no wider than so many pixels."""
    import cv2

    if not path.is_file():
        return None
    data = read_bytes(path)
    require_modest(path, data)
    decode = cv2.IMREAD_REDUCED_COLOR_2 if widest_px < _IMAGE["width_px"] else cv2.IMREAD_COLOR
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), decode) if data else None
    if image is None:
        return None
    height, width = image.shape[:2]
    if width > widest_px:
        image = cv2.resize(image, (widest_px, round(height * widest_px / width)), interpolation=cv2.INTER_AREA)
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _IMAGE["jpeg_quality"]])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode('ascii')}"


@cache
def _plotly_library() -> str:
    """plotly.js, packed: it is five megabytes long."""
    from plotly.offline import get_plotlyjs

    return _compress_to_base64(get_plotlyjs().encode())


def _pack_json(value: Any) -> str:
    return _compress_to_base64(json.dumps(value, separators=(",", ":"), allow_nan=False).encode())


def _compress_to_base64(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")

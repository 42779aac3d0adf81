"""Words of PLY files that are damaged, or cannot be transformed."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state

# lines of the header


@message(example={"element": "vertex"})
def ply_element_twice(element: str) -> str:
    return f"element {element} is declared twice"


@message(example={"line": "property"})
def not_a_ply_line(line: str) -> str:
    return f"not a line of a PLY header: {line!r}"


@message(example={"type": "half"})
def not_a_ply_type(type: str) -> str:
    return f"{type!r} is no PLY type"


@message(example={"property": "x", "element": "vertex"})
def ply_property_twice(property: str, element: str) -> str:
    return f"property {property} of {element} is declared twice"


# why splats are not moved


@message(example={"names": ("opacity", "rot_0")})
def splats_lack_fields(names: Sequence[str]) -> str:
    return f"lack {', '.join(names)}"


state("splats-without-position", "have no position")
state("splats-not-float", "are not floating-point numbers")


@message(example={"count": 7})
def splats_without_harmonics(count: int) -> str:
    return f"have {count} fields f_rest, not those of harmonics of degree 0 to 3"


@message(advice="leave the file out with --keep", example={"fault": {"code": "splats-without-position", "values": {}}})
def splats_not_transformed(fault: Said) -> str:
    return f"its Gaussian splats cannot be transformed, as they {fault}"


@message(example={"text": "300", "bits": 8})
def integer_beyond_bits(text: str, bits: int) -> str:
    return f"{text} does not fit into {bits} bits"


# elements


state("not-a-ply", "not a PLY file", advice="apply copies it as it is with --keep")
state("ply-header-endless", "the PLY header does not end")
state("ply-format-missing", "the PLY header does not state the format")


@message(example={"element": "vertex"})
def ply_rows_without_property(element: str) -> str:
    return f"element {element} has rows but no property"


@message(example={"label": "normals", "present": "nx ny"})
def ply_part_of_vector(label: str, present: str) -> str:
    return f"of the vertices' {label} there is only {present}"


@message(example={"name": "x"})
def ply_field_not_float(name: str) -> str:
    return f"the vertices' {name} is not a floating-point number: it cannot be transformed"


state(
    "ply-lists-not-transformed",
    "vertices with a list property cannot be transformed",
    advice="leave the file out with --keep",
)


@message(example={"rows": 1000, "element": "vertex"})
def ply_rows_beyond(rows: int, element: str) -> str:
    return f"truncated: {rows} rows of {element} do not fit into the file"


@message(example={"left": 12})
def ply_bytes_follow(left: int) -> str:
    return f"damaged: {left} bytes follow the last element"


@message(example={"element": "vertex"})
def ply_truncated(element: str) -> str:
    return f"truncated within element {element}"


@message(example={"count": 100})
def ply_damaged_face(count: int) -> str:
    return f"damaged: a face refers to none of the {count} vertices"


@message(example={"length": 100000000, "element": "face"})
def ply_list_length(length: int, element: str) -> str:
    return f"damaged: a list of {length} values in element {element}"


state("ply-text-follows", "damaged: text follows the last element")


@message(example={"count": 100})
def ply_face_without_vertex(count: int) -> str:
    return f"a face refers to none of the {count} vertices"


@message(example={"element": "vertex"})
def ply_too_few_values(element: str) -> str:
    return f"too few values for element {element}"


@message(example={"element": "vertex", "detail": "could not convert"})
def ply_not_a_value(element: str, detail: str) -> str:
    return f"not a value of element {element}: {detail}"


@message(example={"count": 4, "element": "vertex", "expected": 3})
def ply_other_count(count: int, element: str, expected: int) -> str:
    return f"{count} values where element {element} has {expected}"

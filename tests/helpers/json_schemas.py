"""The documented schemas of JSON files."""

import functools
import json
from pathlib import Path

from jsonschema import Draft202012Validator

SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"


@functools.cache
def read_schema(name: str) -> Draft202012Validator:
    content = json.loads((SCHEMAS / f"{name}.schema.json").read_text())
    Draft202012Validator.check_schema(content)
    return Draft202012Validator(content)


def find_violations(name: str, content: object) -> list[str]:
    """Where a JSON does not have the form that its schema describes; of a file, give its path."""
    content = json.loads(content.read_text()) if isinstance(content, Path) else content
    errors = read_schema(name).iter_errors(content)
    return [f"{'/'.join(map(str, e.absolute_path))}: {e.message[:300]}" for e in errors]

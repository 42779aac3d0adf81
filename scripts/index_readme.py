"""Make README.md's links work on a package index, where the checkout is not beside it.

    python scripts/index_readme.py

Replaces README.md in place, for a checkout that a release is built from: links to files of the checkout lead to the
repository at the version's tag. The address is that of ``[project.urls]`` in ``pyproject.toml``; exit code 2 while
there is none.
"""

import re
import sys
import tomllib
from pathlib import Path

#: A Markdown link whose target is neither an address nor a place on the same page.
LINK = re.compile(r"(\]\()(?![a-z]+:|#)([^)\s]+)(\))")
#: An image, which needs the file itself and not the page about it.
IMAGE = re.compile(r"(!\[[^\]]*\]\()(?![a-z]+:)([^)\s]+)(\))")


def absolute(text: str, repository: str, version: str) -> str:
    """Markdown whose links and images lead to the repository."""
    base = repository.rstrip("/")
    text = IMAGE.sub(rf"\g<1>{base}/raw/v{version}/\g<2>\g<3>", text)
    return LINK.sub(rf"\g<1>{base}/blob/v{version}/\g<2>\g<3>", text)


def main() -> None:
    root = Path(__file__).resolve().parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    repository = project.get("urls", {}).get("Repository")
    if not repository:
        print("index_readme: fill in [project.urls] in pyproject.toml first", file=sys.stderr)
        sys.exit(2)
    readme = root / "README.md"
    readme.write_text(absolute(readme.read_text(encoding="utf-8"), repository, project["version"]), encoding="utf-8")


if __name__ == "__main__":
    main()

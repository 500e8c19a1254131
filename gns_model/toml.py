"""TOML in and out: files that a person reads and edits."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from gns_model.errors import GnsError


def read_toml(path: Path, error: type[GnsError]) -> dict[str, Any]:
    """The values in a TOML file.

    Raises:
        error: if it is missing or is not TOML; one line that names the file.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as fault:
        raise error(f"{path}: cannot be read ({fault.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise error(f"{path}: not a TOML file ({fault})") from None


def toml_text(values: dict[str, Any]) -> str:
    """Plain values as TOML: keys first, then tables and lists of tables, one level deep."""
    lines: list[str] = []
    tables: list[str] = []
    for key, value in values.items():
        if isinstance(value, dict):
            tables += ["", f"[{key}]", *(f"{k} = {_literal(v)}" for k, v in value.items())]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                tables += ["", f"[[{key}]]", *(f"{k} = {_literal(v)}" for k, v in entry.items())]
        elif value != []:
            lines.append(f"{key} = {_literal(value)}")
    return "\n".join(lines + tables) + "\n"


def _literal(value: Any) -> str:
    if isinstance(value, str):
        # JSON escapes what TOML does, except that TOML also forbids a bare DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_literal(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_literal(v)}" for k, v in value.items()) + " }"
    return repr(value)

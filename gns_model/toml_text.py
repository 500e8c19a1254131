"""Plain values as TOML text, for files that a person reads and edits."""

from __future__ import annotations

import json
from typing import Any


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

"""The page's modules as one script, which a page that fetches nothing can hold.

The views share their modules with the dashboard: the same orbit, gestures and shaders.
"""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

from ground_station import presentation

_OWN = Path(__file__).parent / "web"
_SHARED = Path(presentation.__file__).parent / "web" / "js"
_IMPORT = re.compile(r'^import \{([^}]*)\} from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:class|const|function) (\w+))", re.MULTILINE)


def bundle(entry: str) -> str:
    """The module `entry` after all that it imports, each in a scope of its own.

    Understood is what these modules use: named imports on one line and named exports.
    """
    done: list[str] = []
    parts = ['"use strict";']

    def add(name: str) -> None:
        if name in done:
            return
        path = next(p for p in (_OWN / f"{name}.js", _SHARED / f"{name}.js") if p.is_file())
        text = path.read_text(encoding="utf-8")
        for _, needed in _IMPORT.findall(text):
            add(needed)
        done.append(name)
        exported = ", ".join(_EXPORT.findall(text))
        text = _EXPORT.sub("", _IMPORT.sub(r"const {\1} = module_\2;", text))
        parts.append(f"const module_{name} = (() => {{\n{text}\nreturn {{ {exported} }};\n}})();")

    add(entry)
    return "\n".join(parts)


def policy(script: str) -> str:
    """The Content-Security-Policy source that allows this one script."""
    digest = hashlib.sha256(script.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"

"""Extensions of files, and valid file names made from names of poses."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable
from mimetypes import MimeTypes
from pathlib import PurePath

from lcollision_core.files.safe import shortened
from lcollision_core.files.table import FILES


def make_unique(
    names: Iterable[str],
    key: Callable[[str], str] = str,
    joined: Callable[[str, str], str] = str.__add__,
) -> list[str]:
    """Make names unique by key: append a number such as " 2" to later ones.

    Parameters
    ----------
    names : any names
    key : maps a name to the value that must be unique, such as the name in lower case
    joined : appends an ending to a name, and may shorten the name for it
    """
    used_names: set[str] = set()
    counts: Counter[str] = Counter()
    result = []
    for name in names:
        candidate, base = name, key(name)
        while (key_of_it := key(candidate)) in used_names:
            counts[base] += 1
            candidate = joined(name, f" {counts[base] + 1}")
        used_names.add(key_of_it)
        result.append(candidate)
    return result


MAX_STEM_BYTES = 130
"""Most bytes of a name without its extension; file systems allow 143 to 255 in total."""

_OF_OTHER_PROGRAMS = re.compile(
    r"\.(3dm|3ds|3mf|7z|abc|blend|bz2|c4d|dae|docx?|dxf|gz|iges|igs|ini|jsonl|log|lwo|ma|max"
    r"|mb|md|msh|npy|od[pst]|pickle|pkl|pptx|pt|pth|rar|skp|step|stp|toml|usd[acz]?"
    r"|vrml|vtk|vtp|vtu|wrl|x3d|xlsx|xyz|xz|ya?ml|zip|zst|ztl)"
)
_MEDIA = MimeTypes()
"""Extensions known to the standard library, independent of the machine's own lists."""

_NOT_IN_NAMES = re.compile(r'[\x00-\x1f\x7f-\x9f\u2028\u2029<>:"/\\|?*]+')
_RESERVED = re.compile(r"(CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(COM|LPT)[0-9¹²³])\s*(\.|$)", re.I)
"""Device names on Windows, with any extension."""


def has_known_suffix(path: PurePath) -> bool:
    """Whether a name ends in the extension of a known format, unlike ".9" in "walk_v0.9"."""
    suffix = path.suffix.lower()
    if suffix in FILES or suffix in _MEDIA.types_map[True]:
        return True
    return bool(_OF_OTHER_PROGRAMS.fullmatch(suffix))


def file_stem(name: str) -> str:
    """Make a name valid as a file name without extension on common file systems."""
    stem = _cut(_NOT_IN_NAMES.sub("_", name), MAX_STEM_BYTES) or "pose"
    return f"_{_cut(stem, MAX_STEM_BYTES - 1)}" if _RESERVED.match(stem) else stem


def file_stems(names: Iterable[str]) -> list[str]:
    """Return each name's `file_stem`, numbered if an earlier one is the same file: "a", "A 2".

    Some file systems ignore case and the encoding of accents.
    """
    return make_unique(
        map(file_stem, names),
        _folded,
        lambda stem, ending: _cut(stem, MAX_STEM_BYTES - len(ending)) + ending,
    )


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _cut(name: str, n_bytes: int) -> str:
    return shortened(name.strip(" ."), n_bytes).strip(" .")

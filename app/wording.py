"""Formats numbers and names for the user."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.bodies import MirroredPose

_NOT_IN_A_LINE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)

_FAR = 0.03
"""Normalised fit error that is rarely exceeded unless the mesh is another body."""


_MIRRORED = " mirrored"


def overlap_text(energy: float) -> str:
    """Write a normalised energy as the depth that it stands for, as in "1.1 %"."""
    return "none" if energy == 0.0 else height_text(math.sqrt(energy))


def height_text(distance: float) -> str:
    """Write a normalised distance as a fraction of the body size, as in "1.1 %"."""
    percent = 100.0 * distance
    if 0.0 < percent < 0.05:
        return "below 0.1 %"
    return f"{percent:.1f} %"


def share_text(distance: float) -> str:
    """Write a normalised distance that may be small, as in "0.108 % of the body size"."""
    return f"{100.0 * distance:.3g} % of the body size"


def length_text(distance: float, millimetres: float | None) -> str:
    """Write a normalised length in millimetres, of which the body has so many, else in per cent."""
    if millimetres is None:
        return f"{100.0 * distance:.3g} %"
    return f"{millimetres * distance:.3g} mm"


def least_distance_words(least: float | None, clearance: float) -> str:
    """Say how near parts come, normalised; None where nothing is near enough to be looked for."""
    from lcollision_core.contact import DISTANCE_BOUND

    if least is None:
        return f"least distance above {share_text(max(DISTANCE_BOUND, clearance))}"
    if least < 0.0:
        return f"penetrating by up to {share_text(-least)}"
    return f"least distance {share_text(least)}"


def counted(number: int, noun: str, nouns: str | None = None) -> str:
    """Write a number with its noun, "1 pair" or "2 pairs"."""
    return f"{number} {noun if number == 1 else nouns or noun + 's'}"


def grouped(number: int) -> str:
    """Write a large number in groups of three digits, as in "50 000" with narrow spaces."""
    return f"{number:,}".replace(",", "\u202f")


def heading(name: str) -> str:
    """Give a domain's name the capital of a heading."""
    return name[:1].upper() + name[1:]


def seconds_text(seconds: float) -> str:
    """Write a duration as in "90 ms" or "1.4 s"."""
    return f"{1000 * seconds:.0f} ms" if seconds < 0.95 else f"{seconds:.1f} s"


def menu_text(name: str) -> str:
    """Write a name so that a menu, a button or a form's label shows it literally."""
    return one_line(name).replace("&", "&&")


def one_line(text: str) -> str:
    """Write a name, or what has names in it, with escapes for what would end or turn its line."""
    return _NOT_IN_A_LINE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def fit_error(mean: float | None, most: float | None) -> str:
    """Describe the fit error of a mesh, normalised; None for an exact pose."""
    mean, most = mean or 0.0, most or 0.0
    far = ", which is large: is it this body, in the model's vertex order?" if mean > _FAR else ""
    return f"fit error of {100.0 * mean:.3f} % of the body size, at most {100.0 * most:.2f} %{far}"


def mirrored_name(name: str) -> str:
    """Return the name of the mirror image of a pose: "twist left" of "twist right".

    Of a name without a side, "NAME mirrored"; and of that, NAME.
    """
    turned = re.sub(r"\b(left|right)\b", _other_side, name, flags=re.IGNORECASE)
    if turned != name:
        return turned
    return name.removesuffix(_MIRRORED) or name if name.endswith(_MIRRORED) else name + _MIRRORED


def _other_side(word: re.Match[str]) -> str:
    side = word[0]
    other = "left" if side.casefold() == "right" else "right"
    return other.upper() if side.isupper() else other.title() if side.istitle() else other


def mirrored_text(mirrored: MirroredPose) -> str:
    """Describe a mirrored pose: its fit error, and whether it collides."""
    pairs = counted(mirrored.pairs_after, "pair of faces", "pairs of faces")
    if mirrored.pairs_after == 0 < mirrored.pairs_mirrored:
        resolved = counted(mirrored.pairs_mirrored, "pair of faces", "pairs of faces")
        state = f"no collisions (checked), after {resolved} of the mirror image were resolved"
    elif mirrored.lost_freedom:
        state = f"colliding: {pairs} that the original doesn't have"
    elif mirrored.pairs_after:
        state = f"colliding as before: {pairs} (original: {mirrored.pairs_before})"
    else:
        state = "free"
    if mirrored.restored:
        return f"restored to the unmirrored pose, {state}"
    return f"mirrored with a {fit_error(mirrored.fit_error_mean, mirrored.fit_error_max)}, {state}"


def error_rates(false_positive: float | None, false_negative: float | None) -> str:
    """Say how often a predictor errs on either side; None where nothing was there to judge."""
    sides = (
        (false_positive, "free poses called colliding"),
        (false_negative, "colliding poses called free"),
    )
    rates = ((None if rate is None else f"{100.0 * rate:.1f} %", what) for rate, what in sides)
    return ", ".join(f"{rate or 'an unknown share'} of {what}" for rate, what in rates)


def with_capital(text: str) -> str:
    """Begin with a capital, unless the first word is a file's name or a number."""
    word = text.partition(" ")[0]
    return text[:1].upper() + text[1:] if word.isalpha() else text


def duration_text(seconds: float) -> str:
    """Write a time to wait as in "about 25 minutes", no finer than it can be known."""
    minutes = seconds / 60.0
    if minutes < 0.75:
        return "less than a minute"
    if minutes < 1.5:
        return "about 1 minute"
    step = 1 if minutes < 20 else 5
    whole = step * round(minutes / step)
    if whole < 60:
        return f"about {whole} minutes"
    hours, rest = divmod(whole, 60)
    return f"about {hours} h {rest} min" if rest else f"about {hours} h"


def spent_text(seconds: float) -> str:
    """Write a time that has passed as in "40 s", "4 min" or "1 h 5 min"."""
    if seconds < 60.0:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"

"""Whole sentences for people: a translation sets its catalogue as `CATALOGUE`.

`xgettext -k say -k say_number:2,3 -k counted:2,3 -k marked` collects them: each is a literal with
named fields.
"""

from __future__ import annotations

import gettext
from collections.abc import Iterable

CATALOGUE = gettext.NullTranslations()
"""Translations of all sentences; none by default."""


def say(sentence: str, **fields: object) -> str:
    """Return a translated sentence with its fields filled in."""
    return CATALOGUE.gettext(sentence).format(**fields)


def say_number(number: int, one: str, several: str, **fields: object) -> str:
    """Return a translated sentence about a number of things, which its field `n` holds."""
    return CATALOGUE.ngettext(one, several, number).format(n=number, **fields)


def counted(number: int, noun: str, nouns: str) -> str:
    """Return a number with its translated noun, "1 pair" or "2 pairs"."""
    return f"{number} {CATALOGUE.ngettext(noun, nouns, number)}"


def both(first: str, second: str) -> str:
    """Join two names by "and"; equal ones are given once."""
    return first if first == second else say("{first} and {second}", first=first, second=second)


def marked(sentence: str) -> str:
    """Return a sentence as it is, which `say` translates later."""
    return sentence


def joined(sentences: Iterable[str | None]) -> str:
    """Join sentences about one thing; empty ones are left out."""
    return "; ".join(sentence for sentence in sentences if sentence)

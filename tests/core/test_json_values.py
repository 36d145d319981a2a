"""JSON values as typed objects: valid values, and sentences for invalid ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta

from lcollision_core.errors import ShapeError
from lcollision_core.json_values import from_json, parse_json, to_json


@dataclass(frozen=True)
class Part:
    name: str
    size: float = 1.0
    axis: Literal["x", "y"] = "x"

    def __post_init__(self) -> None:
        if self.size < 0.0:
            raise ShapeError("is negative", where=self.name)


@dataclass(frozen=True)
class Whole:
    parts: tuple[Part, ...]
    weights: Annotated[tuple[float, ...], Meta(max_length=2)] = ()
    count: int | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)


def test_values_come_back_as_their_types() -> None:
    whole = Whole((Part("a"), Part("b", 2.0, "y")), (0.5,), None, {"by": [1, "x"]})
    assert from_json(Whole, to_json(whole), "whole") == whole
    assert from_json(Whole, {"parts": [], "weights": [1], "later": 3}, "whole") == Whole((), (1.0,))
    # A file name that is not valid text, as stored by an older version.
    assert from_json(Part, {"name": "\udcffbend"}, "part").name == "?bend"


def test_text_of_another_encoding_is_said() -> None:
    assert parse_json(b"\xef\xbb\xbf[]") == []
    with pytest.raises(ValueError, match=r"^its text is not UTF-8$"):
        parse_json("[]".encode("utf-16"))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ([], "whole must be an object, got []"),
        ({}, "whole lacks parts"),
        ({"parts": [{"name": "a"}, {}]}, "whole.parts[1] lacks name"),
        ({"parts": {}}, "whole.parts must be a list, got {}"),
        ({"parts": [{"name": 5}]}, "whole.parts[0].name must be a string, got 5"),
        ({"parts": [{"name": "a", "size": "1"}]}, "whole.parts[0].size must be a finite number,"),
        ({"parts": [{"name": "a", "axis": "z"}]}, "whole.parts[0].axis must be a known value,"),
        ({"parts": [], "count": True}, "whole.count must be a whole number or null, got True"),
        ({"parts": [], "count": 1.0}, "whole.count must be a whole number or null, got 1.0"),
        ({"parts": [], "count": 2**64}, "whole.count must be a finite number of 64 bits, got"),
        ({"parts": [], "facts": {"n": float("inf")}}, "whole.facts.n must be a finite number"),
        ({"parts": [], "weights": [1, 2, 3]}, "whole.weights must be a list of length at most 2,"),
        ({"parts": [], "facts": 3}, "whole.facts must be an object, got 3"),
        ({"parts": [{"name": "a", "size": -1}]}, "a is negative"),
    ],
)
def test_what_does_not_fit_is_said_with_its_place(values: Any, sentence: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole sentence is compared
        from_json(Whole, values, "whole")
    assert str(caught.value).startswith(sentence)


def test_deep_nesting_is_refused() -> None:
    deep: list[Any] = []
    for _ in range(5000):
        deep = [deep]
    with pytest.raises(ValueError, match="whole is nested too deeply"):
        from_json(Whole, {"parts": [], "facts": {"deep": deep}}, "whole")

"""What a character's file that this program wrote says of itself: its rest pose, and its rules.

It is an object in `asset.extras` of the glTF file, and holds the parts of the source's description
that the pose has changed, so that the source, which may be elsewhere, can be read from it again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lcollision_core.characters.character import Character
from lcollision_core.characters.reading import character_of
from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import quoted
from lcollision_core.meshes.contact_rules import ContactRules
from lcollision_core.meshes.formats.gltf_document import GltfDocument
from lcollision_core.meshes.formats.gltf_scene import read_shown
from lcollision_core.meshes.joined import join_parts
from lcollision_core.meshes.scene_files import SceneDocument, as_file_error, scene_of
from lcollision_core.meshes.topology import FloatArray

_KEY, _VERSION = "lcollision", 1
_LONGEST_NAME = 100
_CLIPS, _SHOWING = "animations", ("scale", "weights")
_CHANGED = ("nodes", "meshes", "skins", "scenes", "scene")
"""What a pose changes of a description, apart from its animations."""


def sign(
    patch: GltfDocument,
    source: dict[str, Any],
    character: Character,
    shown_by: Sequence[int],
    rules: ContactRules,
) -> None:
    """Write into a file that holds a pose what it was before, and which pairs do not count.

    Parameters
    ----------
    patch : the file, complete
    source : the description that it had
    character : with a rig, of that source
    shown_by : of each of its parts the number of the node that shows it now
    rules : of the character
    """
    asset = patch.description.get("asset", {})
    extras = asset.get("extras", {}) if isinstance(asset, dict) else None
    if not isinstance(extras, dict):
        # They are the source's own.
        return
    patch.description["asset"] = asset = {**asset, "extras": {**extras}}
    before = {name: source.get(name) for name in _CHANGED}
    before = {name: value for name, value in before.items() if value != patch.description.get(name)}
    before[_CLIPS] = _brief(source)
    asset["extras"][_KEY] = {
        "format_version": _VERSION,
        "character": character.name,
        "roles": {} if character.rig is None else dict(character.rig.chosen),
        "rules": rules.to_json(),
        "source": before,
        "shown_by": list(shown_by),
        "digest": patch.digest(_KEY),
    }


def _brief(source: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the source's animations without how they turn and move its joints.

    What is left says which parts are a character's, and which faces are ever seen.
    """
    joints = {node for skin in source.get("skins", ()) for node in skin["joints"]}
    found = []
    for animation in source.get(_CLIPS, ()):
        kept = [
            channel
            for channel in animation.get("channels", ())
            if channel["target"].get("path") in _SHOWING
            or channel["target"].get("node") not in (None, *joints)
        ]
        if kept:
            samplers = [animation["samplers"][channel["sampler"]] for channel in kept]
            channels = [channel | {"sampler": n} for n, channel in enumerate(kept)]
            found.append({"channels": channels, "samplers": samplers})
    return found


@dataclass(frozen=True, eq=False)
class OwnFile:
    """A file that this program wrote with a pose in it.

    Attributes
    ----------
    character : in its rest pose, without clips
    vertices : (V, 3) float64 array, the pose
    rules : that the character had
    roles : what its joints had been said to be, by their names
    """

    character: Character
    vertices: FloatArray
    rules: ContactRules
    roles: dict[str, str]


def read_own_file(document: SceneDocument) -> OwnFile | None:
    """Read a file that this program wrote with a pose in it; None for any other.

    Raises
    ------
    MeshFileError : it was changed since, by another program, or is of a later version.
    """
    if not isinstance(document, GltfDocument):
        return None
    path = document.path
    with as_file_error(path, "can't be checked by the rules that it was exported with"):
        asset = document.description.get("asset")
        extras = asset.get("extras") if isinstance(asset, dict) else None
        held = extras.get(_KEY) if isinstance(extras, dict) else None
        if not isinstance(held, dict):
            return None
        version = held.get("format_version")
        if version != _VERSION:
            raise MeshFileError.must_be(
                "its version", _VERSION, quoted(version), "update LCollision"
            )
        if held.get("digest") != document.digest(_KEY):
            raise MeshFileError("another program has changed it since", "export it again")
        shown_by, source, name = held.get("shown_by"), held.get("source"), held.get("character")
        roles = held.get("roles")
        if not (
            isinstance(source, dict)
            and isinstance(name, str)
            and isinstance(shown_by, list)
            and all(type(node) is int for node in shown_by)
            and isinstance(roles, dict)
            and all(isinstance(role, str) for role in roles.values())
        ):
            raise MeshFileError("what it says of its source is damaged", "export it again")
        rules = ContactRules.from_json(held.get("rules"))
        posed = read_shown(document)
        before = {key: source[key] for key in (*_CHANGED, _CLIPS) if key in source}
        source_document = document.described(document.description | before)
        character = character_of(scene_of(source_document), path)
        shown = "".join(filter(str.isprintable, name))[:_LONGEST_NAME]
        character = replace(character, name=shown or character.name, clips={})
        mesh = join_parts(posed)
        places = mesh.posed(posed.rest)[0][mesh.joined]
        rows: dict[int, list[FloatArray]] = {}
        starts = np.cumsum([0, *(len(part.points) for part in posed.parts)]).tolist()
        for part, start, end in zip(posed.parts, starts[:-1], starts[1:], strict=True):
            rows.setdefault(part.node, []).append(places[start:end])
        in_order = [rows[node].pop(0) for node in shown_by if rows.get(node)]
        found = np.concatenate(in_order) if in_order else np.empty((0, 3))
        if found.shape != (len(character.joined), 3):
            raise MeshFileError("its vertices are not those of its source", "export it again")
        vertices = np.empty_like(character.rest_vertices)
        vertices[character.joined] = found
        return OwnFile(character, vertices, rules, roles)

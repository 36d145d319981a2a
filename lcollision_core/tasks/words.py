"""Sentences that report results to people, and the formatting of numbers and names in them.

Each sentence is complete, with named fields, and goes through `say` or `say_number`. A verdict is a
list of sentences joined by semicolons.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lcollision_core.errors import listed
from lcollision_core.sentences import both
from lcollision_core.sentences import counted as counted
from lcollision_core.sentences import joined as joined
from lcollision_core.sentences import say as say
from lcollision_core.sentences import say_number as say_number

if TYPE_CHECKING:
    from lcollision_core.bodies import MirroredPose
    from lcollision_core.meshes import UpGuess
    from lcollision_core.resolve import ResolveResult
    from lcollision_core.tasks.verdicts import CheckedClip, CheckedMesh, PrintedFigure, ResolvedClip

_NOT_IN_A_LINE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)

_FAR = 0.03
"""Normalised fit error that is rarely exceeded unless the mesh is of another body."""


_MIRRORED = " mirrored"


def overlap_text(energy: float) -> str:
    """Format a normalised energy as its equivalent depth, as in "1.1 %"."""
    return say("none") if energy == 0.0 else height_text(math.sqrt(energy))


def height_text(distance: float, digits: int = 1) -> str:
    """Format a normalised distance as a share of the body size, as in "1.1 %" or "below 0.1 %"."""
    percent, least = 100.0 * distance, 10.0**-digits
    if 0.0 < percent < least / 2:
        return say("below {least:g} %", least=least)
    return f"{percent:.{digits}f} %"


def share_text(distance: float) -> str:
    """Format a normalised, possibly small distance, as in "0.108 % of the body size"."""
    return say("{percent:.3g} % of the body size", percent=100.0 * distance)


def length_text(distance: float, millimetres: float | None) -> str:
    """Format a normalised length in millimetres if the body's size is given, else in per cent."""
    if millimetres is None:
        return f"{100.0 * distance:.3g} %"
    return f"{millimetres * distance:.3g} mm"


def least_distance_words(least: float | None, clearance: float) -> str:
    """Describe the least distance of parts, normalised; None if above the search bound."""
    from lcollision_core.contact import DISTANCE_BOUND

    if least is None:
        bound = share_text(max(DISTANCE_BOUND, clearance))
        return say("least distance above {distance}", distance=bound)
    if least < 0.0:
        return say("penetrating by up to {depth}", depth=share_text(-least))
    return say("least distance {distance}", distance=share_text(least))


def grouped(number: int) -> str:
    """Format a large number in groups of three digits, as in "50 000" with narrow spaces."""
    return f"{number:,}".replace(",", "\u202f")


def heading(name: str) -> str:
    """Capitalise a domain's name as a heading, but not that of its body in a scene."""
    body, colon, part = name.rpartition(": ")
    return f"{body}{colon}{part[:1].upper()}{part[1:]}"


def seconds_text(seconds: float) -> str:
    """Format a duration as in "90 ms" or "1.4 s"."""
    return f"{1000 * seconds:.0f} ms" if seconds < 0.95 else f"{seconds:.1f} s"


def menu_text(name: str) -> str:
    """Escape a name so that a menu, a button or a form label shows it literally."""
    return one_line(name).replace("&", "&&")


def one_line(text: str) -> str:
    """Escape the characters of a text that would break or reverse its line."""
    return _NOT_IN_A_LINE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def fit_error(mean: float | None, most: float | None, *, is_mirrored: bool = False) -> str:
    """Describe the fit error of a mesh, normalised; None for an exact pose."""
    fields = {"mean": 100.0 * (mean or 0.0), "most": 100.0 * (most or 0.0)}
    if is_mirrored and (mean or 0.0) > _FAR:
        return say(
            "fit error of {mean:.3f} % of the body size, at most {most:.2f} %, which is large: the "
            "body is not symmetric, or cannot take this pose",
            **fields,
        )
    if (mean or 0.0) > _FAR:
        return say(
            "fit error of {mean:.3f} % of the body size, at most {most:.2f} %, which is large: is "
            "it this body, in the model's vertex order?",
            **fields,
        )
    return say("fit error of {mean:.3f} % of the body size, at most {most:.2f} %", **fields)


def mirrored_name(name: str) -> str:
    """Return the name of a pose's mirror image: "twist left" for "twist right".

    For a name without a side it is "NAME mirrored"; and for that, NAME.
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
    """Describe a mirrored pose: its fit error, and its collisions."""
    if mirrored.pairs_after == 0 < mirrored.pairs_mirrored:
        state = say_number(
            mirrored.pairs_mirrored,
            "no collisions (checked), after {n} pair of faces of the mirror image was resolved",
            "no collisions (checked), after {n} pairs of faces of the mirror image were resolved",
        )
    elif mirrored.collides_newly:
        state = say_number(
            mirrored.pairs_after,
            "colliding: {n} pair of faces that the original doesn't have",
            "colliding: {n} pairs of faces that the original doesn't have",
        )
    elif mirrored.pairs_after:
        state = say_number(
            mirrored.pairs_after,
            "colliding as before: {n} pair of faces (original: {before})",
            "colliding as before: {n} pairs of faces (original: {before})",
            before=mirrored.pairs_before,
        )
    else:
        state = say("free")
    if mirrored.restored:
        return say("restored to the unmirrored pose, {state}", state=state)
    error = fit_error(mirrored.fit_error_mean, mirrored.fit_error_max, is_mirrored=True)
    return say("mirrored with a {error}, {state}", error=error, state=state)


def up_text(guess: UpGuess) -> str:
    """Describe which axis was taken as up, and why."""
    axis = "xyz"[guess.axis]
    if guess.is_sure:
        return say("{axis} is up: {reason}", axis=axis, reason=guess.reason)
    return say("{axis} is probably up: {reason}", axis=axis, reason=guess.reason)


def scores_text(scores: Mapping[str, Any], n_samples: int | None = None) -> str:
    """Describe a predictor's scores, named as in `PredictorMetrics`, on samples unseen by it."""
    fields = {
        "accuracy": 100.0 * scores["accuracy"],
        "majority": 100.0 * scores["majority_rate"],
        "rates": error_rates_text(scores["false_positive_rate"], scores["false_negative_rate"]),
    }
    if n_samples is None:
        return say(
            "accuracy {accuracy:.1f} % on unseen samples (majority baseline: {majority:.1f} %), "
            "{rates}",
            **fields,
        )
    return say_number(
        n_samples,
        "accuracy {accuracy:.1f} % on {n} unseen sample (majority baseline: {majority:.1f} %), "
        "{rates}",
        "accuracy {accuracy:.1f} % on {n} unseen samples (majority baseline: {majority:.1f} %), "
        "{rates}",
        **fields,
    )


def error_rates_text(false_positive: float | None, false_negative: float | None) -> str:
    """Describe a predictor's error rates; None if there were no poses to judge."""
    wrong, missed = (
        say("an unknown share") if rate is None else f"{100.0 * rate:.1f} %"
        for rate in (false_positive, false_negative)
    )
    return say(
        "{wrong} of free poses called colliding, {missed} of colliding poses called free",
        wrong=wrong,
        missed=missed,
    )


def with_capital(text: str) -> str:
    """Capitalise a text, unless its first word is a file name or a number."""
    word = text.partition(" ")[0]
    return text[:1].upper() + text[1:] if word.isalpha() else text


def left_text(seconds: float) -> str:
    """Format a remaining time as in "about 25 minutes left"."""
    return say("{left} left", left=duration_text(seconds))


def duration_text(seconds: float) -> str:
    """Format a remaining time as in "about 25 minutes", in plausible precision."""
    minutes = seconds / 60.0
    if minutes < 0.75:
        return say("less than a minute")
    step = 1 if minutes < 20 else 5
    whole = step * round(minutes / step)
    if whole < 60:
        return say_number(whole, "about {n} minute", "about {n} minutes")
    hours, rest = divmod(whole, 60)
    if rest:
        return say("about {hours} h {minutes} min", hours=hours, minutes=rest)
    return say("about {hours} h", hours=hours)


def spent_text(seconds: float) -> str:
    """Format an elapsed time as in "40 s", "4 min" or "1 h 5 min"."""
    if seconds < 60.0:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def frames_text(frames: Sequence[object]) -> str:
    """List frames, by number or in pairs, at most ten."""
    first = ", ".join(map(str, frames[:10]))
    return say("{frames} ...", frames=first) if len(frames) > 10 else first


def between_text(frames: Sequence[int]) -> str:
    """Describe contacts between frames, by the frames before and after."""
    pairs = [say("{at} and {after}", at=at, after=at + 1) for at in frames]
    return say("contact between frames {frames}", frames=frames_text(pairs))


_NAMED_PARTS = 4
"""Number of pairs of parts that the verdict of a scene names."""


def checked_mesh_text(verdict: CheckedMesh) -> str:
    """Describe the check of one mesh."""
    if verdict.clearance > 0.0:
        near = share_text(verdict.clearance)
        least = least_distance_words(verdict.least_distance, verdict.clearance)
        if verdict.colliding:
            text = say_number(
                verdict.pairs,
                "{n} pair of faces nearer than {distance}, {least}",
                "{n} pairs of faces nearer than {distance}, {least}",
                distance=near,
                least=least,
            )
        else:
            text = say("no faces nearer than {distance}, {least}", distance=near, least=least)
    elif verdict.colliding:
        text = say_number(
            verdict.pairs,
            "colliding, {n} pair of faces, normalised energy {energy:.3g}",
            "colliding, {n} pairs of faces, normalised energy {energy:.3g}",
            energy=verdict.energy,
        )
    else:
        text = say("no collisions")
    text = joined([text, *verdict.parts[:_NAMED_PARTS], verdict.not_counted])
    if verdict.rules_of is not None:
        text = say(
            "{verdict}, by the contact rules of {body} (--no-rules counts all pairs)",
            verdict=text,
            body=verdict.rules_of,
        )
    return say(
        "{file}: {verdict} ({vertices}, {faces}, {seconds:.2f} s)",
        file=verdict.file,
        verdict=text,
        vertices=counted(verdict.vertices, "vertex", "vertices"),
        faces=counted(verdict.faces, "face", "faces"),
        seconds=verdict.seconds,
    )


def in_between_text(n_poses: int) -> str:
    """Describe collisions between free frames; "" for none."""
    if not n_poses:
        return ""
    return say_number(
        n_poses,
        "{n} pose between free frames collides",
        "{n} poses between free frames collide",
    )


def checked_clip_table(verdicts: Iterable[CheckedClip]) -> list[str]:
    """Return the lines of a table of clips, sorted by depth, deepest first."""
    ranked = sorted(verdicts, key=lambda v: (-v.deepest, -len(v.colliding_frames), v.file))
    lines = [f"{say('deepest'):>12}  {say('frames that collide'):>19}  {say('clip')}"]
    for verdict in ranked:
        frames = say("{some} of {n}", some=len(verdict.colliding_frames), n=verdict.frames)
        deepest = height_text(verdict.deepest, 2)
        lines.append(f"{deepest:>12}  {frames:>19}  {verdict.file}: {verdict.clip}")
    return lines


def checked_clip_text(verdict: CheckedClip) -> str:
    """Describe the check of one clip."""
    frames, n_frames = verdict.colliding_frames, counted(verdict.frames, "frame", "frames")
    near = share_text(verdict.clearance)
    parts: list[str | None] = []
    if not verdict.colliding:
        if verdict.clearance > 0.0:
            head = say(
                "no faces nearer than {distance} in {frames}", distance=near, frames=n_frames
            )
        else:
            head = say("no collisions in {frames}", frames=n_frames)
        if verdict.collides_between is not None:
            head = say("{verdict}, and no contact between them", verdict=head)
        parts.append(head)
    if frames and verdict.clearance > 0.0:
        parts.append(
            say_number(
                len(frames),
                "{n} of {frames} has faces nearer than {distance}",
                "{n} of {frames} have faces nearer than {distance}",
                frames=n_frames,
                distance=near,
            )
        )
    elif frames:
        worst = max(frames, key=lambda frame: frame.deepest)
        parts.append(
            say_number(
                len(frames),
                "{n} of {frames} collides, deepest frame {frame} by {depth} of the body "
                "size ({parts})",
                "{n} of {frames} collide, deepest frame {frame} by {depth} of the body "
                "size ({parts})",
                frames=n_frames,
                frame=worst.frame,
                depth=height_text(worst.deepest, 2),
                parts=both(*worst.parts[0]),
            )
        )
    parts.append(in_between_text(len(verdict.in_between)))
    if verdict.collides_between:
        parts.append(between_text(verdict.collides_between))
    if verdict.estimated_frames:
        parts.append(
            say_number(
                verdict.estimated_frames,
                "{n} frame free by the estimate",
                "{n} frames free by the estimate",
            )
        )
    if verdict.clearance > 0.0:
        least = least_distance_words(verdict.least_distance, verdict.clearance)
        if verdict.least_frame is not None:
            least = say("{least} in frame {frame}", least=least, frame=verdict.least_frame)
        parts.append(least)
    parts.append(contacts_text(verdict.contacts))
    parts.append(ground_text(verdict.ground))
    parts.append(verdict.not_counted)
    return say(
        "{file}: {clip}: {verdict}", file=verdict.file, clip=verdict.clip, verdict=joined(parts)
    )


def resolved_pose_text(
    result: ResolveResult,
    clearance: float,
    *,
    has_detail: bool,
    fit: float | None,
    colliding_parts: Sequence[str] = (),
) -> str:
    """Describe the outcome of resolving one pose.

    Parameters
    ----------
    result : for a mesh, that of the nearest pose
    clearance : as requested, normalised
    has_detail : whether the output includes the detail lost by encoding
    fit : mean fit error of the encoded mesh, normalised; None for a pose
    colliding_parts : pairs of names of parts that still penetrate, most pairs of faces first
    """
    from lcollision_core.resolve import Step

    moved = {
        "mean": 100.0 * result.vertex_distance_mean,
        "most": 100.0 * result.vertex_distance_max,
    }
    before, after = (
        counted(pairs or 0, "pair of faces", "pairs of faces")
        for pairs in (result.pairs_before, result.pairs_after)
    )
    if result.exactly_free is None and result.predicted_free:
        text = say(
            "predicted free, not checked, moved by {mean:.2f} % of the body size, at most "
            "{most:.1f} %",
            **moved,
        )
    elif result.exactly_free is None:
        text = say(
            "still predicted to collide, not checked, moved by {mean:.2f} % of the body size, at "
            "most {most:.1f} %",
            **moved,
        )
    elif result.exactly_free and result.step == Step.UNCHANGED:
        text = say("already free")
    elif result.exactly_free:
        text = say(
            "resolved {pairs} by the step {step}, checked, moved by {mean:.2f} % of the body size, "
            "at most {most:.1f} %",
            pairs=before,
            step=result.step,
            **moved,
        )
    elif result.step == Step.SOFT:
        text = say(
            "still colliding, {pairs} of {before}, up to {depth} deep, overlap {share:.0f} % of "
            "before, moved by {mean:.2f} % of the body size, at most {most:.1f} %",
            pairs=after,
            before=result.pairs_before,
            depth=share_text(result.deepest_after or 0.0),
            share=100.0 * (result.energy_after or 0.0) / (result.energy_before or 1.0),
            **moved,
        )
    else:
        text = say("still colliding, {pairs}", pairs=after)
    if colliding_parts:
        names = listed(colliding_parts, 3)
        text = say("{verdict}, most of {names}", verdict=text, names=names)
    if has_detail:
        text = say("{verdict}, with its detail", verdict=text)
    elif fit is not None:
        text = say(
            "{verdict}, written as the nearest model pose, {error:.2f} % of the body size off",
            verdict=text,
            error=100.0 * fit,
        )
    elif result.step == Step.UNCHANGED:
        text = say("{verdict}, unchanged", verdict=text)
    if clearance > 0.0 and result.exactly_free is not None:
        least = least_distance_words(result.least_distance, clearance)
        text = say("{verdict}, {least}", verdict=text, least=least)
    return say("{verdict} ({seconds:.2f} s)", verdict=text, seconds=result.seconds)


def resolved_clip_text(verdict: ResolvedClip) -> str:
    """Describe the outcome of resolving one motion of a file."""
    n, after, stuck = verdict.frames, verdict.free_after, verdict.colliding_frames
    fields = {
        "before": verdict.free_before,
        "frames": counted(n, "frame", "frames"),
        "after": after,
    }
    if not verdict.output:
        head = say("{before} of {frames} free", **fields)
    elif after == n:
        head = say("{before} of {frames} free before, all after", **fields)
    else:
        head = say("{before} of {frames} free before, {after} after", **fields)
    if stuck:
        head = say_number(
            len(stuck),
            "{verdict} (frame {frames} collides)",
            "{verdict} (frames {frames} collide)",
            verdict=head,
            frames=frames_text(stuck),
        )
    parts: list[str | None] = [head]
    if not verdict.output and verdict.deepest_before:
        depth = height_text(verdict.deepest_before, 2)
        parts.append(say("up to {depth} of the body size deep", depth=depth))
    if not verdict.output:
        parts.append(in_between_text(verdict.in_between_before))
    elif verdict.in_between_before or verdict.in_between_after:
        parts.append(
            say(
                "collisions in between: {before} before, {after} after",
                before=verdict.in_between_before,
                after=verdict.in_between_after,
            )
        )
    if verdict.collides_between:
        parts.append(between_text(verdict.collides_between))
    elif verdict.collides_between is not None and after == n:
        parts.append(say("no contact between them"))
    parts += [str(span["sentence"]) for span in verdict.kept_spans]
    parts += [
        say(
            "frames {first} to {last} are not smooth, because the budget ended first",
            first=first,
            last=last,
        )
        for first, last in verdict.rough_spans
    ]
    if verdict.largest_change:
        parts.append(
            say(
                "moved by {mean:.2f} % of the body size on average, {most:.1f} % at most; "
                "acceleration ratio {ratio:.2f}",
                mean=100.0 * verdict.mean_change,
                most=100.0 * verdict.largest_change,
                ratio=verdict.acceleration_ratio,
            )
        )
    if verdict.clearance > 0.0:
        parts.append(least_distance_words(verdict.least_distance, verdict.clearance))
    parts.append(contacts_text(verdict.contacts))
    parts.append(ground_text(verdict.ground))
    parts.append(verdict.not_counted)
    return say(
        "{file}: {clip}: {verdict} ({seconds:.1f} s)",
        file=verdict.source,
        clip=verdict.clip,
        verdict=joined(parts),
        seconds=verdict.seconds,
    )


def ground_text(ground: dict[str, Any] | None) -> str | None:
    """Describe how a motion stands on the ground; None if there is none."""
    if ground is None:
        return None
    if not ground["standing_frames"] and not ground["sink"]:
        return say("nothing stands on the ground")
    fields = ground | {name: 100.0 * ground[name] for name in ("sink", "gap", "slide")}
    sinks = say("nothing sinks into the ground")
    if ground["sink"]:
        sinks = say(
            "sinks into the ground by {sink:.2f} % of the body size at most (frame {sink_frame})",
            **fields,
        )
    stands = say(
        "feet that stand float by {gap:.2f} % (frame {gap_frame}) and slide by {slide:.2f} % "
        "(frame {slide_frame}) at most",
        **fields,
    )
    return joined([sinks, stands])


def contacts_text(contacts: dict[str, Any] | None) -> str | None:
    """Describe how many of the source body's contacts a motion keeps; None if it has none."""
    if contacts is None or not contacts["frames"]:
        return None
    lost = [both(*names) for names in contacts["lost"]]
    contact_text = say(
        "{kept} of {all} contacts kept; together in {together} of {frames} frames, counted per "
        "contact",
        kept=len(contacts["kept"]),
        all=len(contacts["kept"]) + len(lost),
        together=contacts["frames_together"],
        frames=contacts["frames"],
    )
    named = list(dict.fromkeys(lost))[:_NAMED_CONTACTS]
    return (
        say("{said} (lost: {named})", said=contact_text, named="; ".join(named))
        if named
        else contact_text
    )


_NAMED_CONTACTS = 4


def exported_text(
    name: str, n_colliding: int, n_frames: int | None, notes: Iterable[str | None] = ()
) -> str:
    """Describe an export and the check of its file.

    Parameters
    ----------
    name : of the file, or of several
    n_colliding : number of pairs of triangles of a pose, or of frames of a motion
    n_frames : number of checked frames; None for a pose
    notes : further sentences
    """
    if n_frames == 0:
        verdict = say("Exported {name}: no clip was changed", name=name)
    elif not n_colliding:
        verdict = say("Exported {name}: no collisions (checked)", name=name)
    elif n_frames is None:
        verdict = say_number(
            n_colliding,
            "Exported {name}: {n} pair of its triangles collides",
            "Exported {name}: {n} pairs of its triangles collide",
            name=name,
        )
    else:
        verdict = say_number(
            n_colliding,
            "Exported {name}: {n} of {frames} collides",
            "Exported {name}: {n} of {frames} collide",
            name=name,
            frames=counted(n_frames, "frame", "frames"),
        )
    return joined([verdict, *notes])


def printed_text(figure: PrintedFigure) -> str:
    """Describe a file written for printing."""
    x, y, z = figure.size
    layers = [
        text
        for number, text in (
            (figure.closed, counted(figure.closed, "closed layer", "closed layers")),
            (figure.capped, counted(figure.capped, "capped layer", "capped layers")),
            (figure.thickened, counted(figure.thickened, "thickened layer", "thickened layers")),
        )
        if number
    ]
    parts = [
        say(
            "{output}: one closed volume of {volume} cm³, {size} mm, {faces} faces, no "
            "self-crossing (checked)",
            output=figure.output,
            volume=f"{figure.volume / 1000.0:.3g}",
            size=" x ".join(f"{side:.1f}" for side in (x, y, z)),
            faces=figure.n_faces,
        ),
        say("of {layers}", layers=", ".join(layers)),
    ]
    if figure.pairs_before and not figure.pairs_after:
        parts.append(say("the pose was resolved"))
    if figure.pairs_after:
        parts.append(
            say_number(
                figure.pairs_after,
                "{n} pair of faces still collided and grew together",
                "{n} pairs of faces still collided and grew together",
            )
        )
    if figure.pins:
        parts.append(
            say_number(
                len(figure.pins),
                "{n} loose part joined by a pin",
                "{n} loose parts joined by pins",
            )
        )
    if figure.thin_share:
        parts.append(
            say(
                "the wall is thinner than {wall} mm on {share} of the surface, most in {places}",
                wall=f"{figure.wall:g}",
                share=height_text(figure.thin_share),
                places=", ".join(figure.thin_places),
            )
        )
    return joined(parts)

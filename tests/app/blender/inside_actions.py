"""Tasks with actions inside Blender: see `inside.py`."""

import bpy
import inside
import numpy as np
from mathutils import Matrix, Quaternion, Vector


def reported(kind):
    """Run an operator at once; return its result and its reports."""
    reports = []

    def report(_, levels, text):
        reports.append([*levels, text])

    bases = tuple(one for one in kind.__bases__ if one is not bpy.types.Operator)
    own = {name: one for name, one in vars(kind).items() if not name.startswith("__")}
    stand_in = type("StandIn", bases, own | {"report": report})
    return [[*stand_in().execute(bpy.context)], *reports]


def spans_of(armature, n_frames, do):
    """Call `do`, which resolves an action; return its spans and the points before and after."""
    actions, tried, scene = inside.module("actions"), set(), bpy.context.scene
    rows_of = actions.ActionCopy._rows

    def record(self, turned):
        tried.update((one.start, one.stop) for one in turned)
        return rows_of(self, turned)

    actions.ActionCopy._rows = record
    frames = range(scene.frame_start, scene.frame_start + n_frames)
    before = points_of_frames(armature, frames)
    answer = {"said": do(), "before": before}
    actions.ActionCopy._rows = rows_of
    spans = []
    for start, stop in sorted(tried):
        if spans and start <= spans[-1][1]:
            spans[-1][1] = max(stop, spans[-1][1])
        else:
            spans.append([start, stop])
    return answer | {"spans": spans, "after": points_of_frames(armature, frames)}


def points_of_frames(armature, frames):
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        found.append(inside.world_points(armature))
    return found


def sparse_action(path, folder):
    """Resolve an action of few smooth keys with free ends; save it and open it again."""
    armature, actions = inside.load(path), inside.module("actions")
    bpy.context.scene.frame_start = 1
    bone, other = armature.pose.bones["LeftArm"], armature.pose.bones["Head"]
    bone.rotation_mode = "YXZ"
    for frame, degrees in ((1, 60.0), (30, 105.0), (60, 60.0)):
        bone.matrix_basis.identity()
        bpy.context.view_layer.update()
        inside.turned(bone, armature, degrees)
        bone.keyframe_insert("rotation_euler", frame=frame)
        bone.location = (0.0, 0.0002 * frame, 0.0)
        bone.keyframe_insert("location", frame=frame)
        other.location = (0.0, 0.0001 * frame, 0.0)
        other.keyframe_insert("location", frame=frame)
    action = armature.animation_data.action
    others = {
        one: value for one, value in inside.keys(action, armature).items() if "location" in one
    }
    answer = spans_of(armature, 60, lambda: reported(actions.LCOLLISION_OT_resolve_action))
    new = armature.animation_data.action
    answer |= {
        "verdict": inside.settings().verdict,
        "others": others
        == {one: value for one, value in inside.keys(new, armature).items() if one in others},
        "keys": {
            name: [key[0] for key in values] for name, values in inside.keys(new, armature).items()
        },
        "old_keys": {name: len(values) for name, values in inside.keys(action, armature).items()},
        "faces": inside.triangles(armature),
        "groups": inside.groups_of(armature),
        "actions": [action.name, new.name],
    }
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/saved.blend")
    bpy.ops.wm.open_mainfile(filepath=f"{folder}/saved.blend")
    return answer | {"reopened": sorted(one.name for one in bpy.data.actions)}


def random_curve(random, item):
    """Give an object a curve with keys of random kinds."""
    item.animation_data_clear()
    item.keyframe_insert("location", index=0, frame=1)
    (curve,) = inside.module("keys").curves_of(item.animation_data.action, item)
    n = int(random.integers(2, 9))
    times = np.sort(random.choice(np.arange(-5.0, 70.0), n, replace=False))
    times += random.uniform(-0.4, 0.4, n) * random.integers(0, 2)
    curve.keyframe_points.clear()
    curve.keyframe_points.add(n)
    kinds = ("BEZIER", "BEZIER", "LINEAR", "CONSTANT", "BOUNCE", "SINE")
    handles = ("AUTO", "AUTO_CLAMPED", "FREE", "ALIGNED", "VECTOR")
    for key, time_of_key in zip(curve.keyframe_points, times, strict=True):
        key.co = time_of_key, random.normal()
        key.interpolation = str(random.choice(kinds))
        key.handle_left_type = key.handle_right_type = str(random.choice(handles))
        key.handle_left = time_of_key - random.uniform(0, 40), random.normal()
        key.handle_right = time_of_key + random.uniform(0, 40), random.normal()
    curve.extrapolation = str(random.choice(["CONSTANT", "LINEAR"]))
    curve.update()
    return curve


def rekeyed(n_curves):
    """Write other values into spans of random curves; return the errors of all frames."""
    rekey, random = inside.module("keys").rekey, np.random.default_rng(5)
    item = bpy.data.objects.new("item", None)
    numbers, answer = list(range(1, 61)), []
    for _ in range(int(n_curves)):
        curve = random_curve(random, item)
        n_keys, begin = len(curve.keyframe_points), int(random.integers(0, 50))
        spans = [range(begin, begin + int(random.integers(1, 10)))]
        if begin > 20:
            spans.insert(0, range(0, int(random.integers(2, 15))))
        frames = range(-20, 100)
        was = np.array([curve.evaluate(frame) for frame in frames])
        before = np.array([[curve.evaluate(number)] for number in numbers], np.float32)
        after, within = before.copy(), np.zeros(len(frames), np.bool_)
        for span in spans:
            after[span.start : span.stop, 0] += np.sin(np.linspace(0.0, np.pi, len(span) + 2))[1:-1]
            within[[numbers[at] - frames.start for at in span]] = True
        rekey([curve], [False], numbers, before, after, [(span, 1e-2) for span in spans])
        curve.update()
        now = np.array([curve.evaluate(frame) for frame in frames])
        # Beyond the original keys, a curve continues from the outermost.
        first, last = curve.range()
        shown = np.array([first <= frame <= last for frame in frames])
        wanted = np.concatenate([after[span.start : span.stop, 0] for span in spans])
        answer.append(
            {
                "outside": int((now != was)[shown & ~within].sum()),
                "inside": float(np.abs(now[within] - wanted).max()),
                "added": len(curve.keyframe_points) - n_keys,
                "span": int(within.sum()),
            }
        )
    return answer


def swing(armature, frames=((1, 60.0), (6, 105.0), (11, 60.0))):
    """Key the left arm, which runs into the trunk; return the action."""
    bone = armature.pose.bones["LeftArm"]
    for frame, degrees in frames:
        bone.matrix_basis.identity()
        bpy.context.view_layer.update()
        inside.turned(bone, armature, degrees)
        bone.keyframe_insert("rotation_quaternion", frame=frame)
    return armature.animation_data.action


def state(armature):
    """Return the state that a refused or reverted resolution must leave."""
    action = armature.animation_data.action
    return {
        "action": action.name,
        "keys": inside.keys(action, armature),
        "fake": action.use_fake_user,
        "actions": sorted(bpy.data.actions.keys()),
        "objects": sorted(bpy.data.objects.keys()),
        "pose": inside.rotations(armature),
    }


def refusals(path):
    """Request checks that would not apply to the pose, and results that cannot be written."""
    armature, actions = inside.load(path), inside.module("actions")
    operators, link = inside.module("operators"), inside.module("link")
    (mesh,) = inside.meshes_of(armature)
    (modifier,) = (one for one in mesh.modifiers if one.type == "ARMATURE")
    swing(armature)
    before, answer = state(armature), {}

    def ask(name, kind=operators.LCOLLISION_OT_check_pose):
        answer[name] = reported(kind)[1:]

    for item in (armature, mesh):
        bpy.context.view_layer.objects.active = item
        bpy.ops.object.mode_set(mode="EDIT")
        ask(f"edit {item.type}")
        bpy.ops.object.mode_set(mode="OBJECT")
    armature.data.pose_position = "REST"
    ask("rest")
    armature.data.pose_position = "POSE"
    modifier.show_viewport = False
    ask("modifier")
    modifier.show_viewport = True
    for scale in ((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)):
        armature.scale = scale
        bpy.context.view_layer.update()
        ask(f"scale {scale[0]}")
    armature.scale = (1.0, 1.0, 1.0)
    bpy.context.view_layer.update()
    settled = link.Path(link.__file__).with_name("engine.json")
    text = settled.read_text()
    for damaged in ("", "{", "[]", '{"python": 1}'):
        settled.write_text(damaged)
        ask(f"engine {damaged}")
    settled.write_text(text)
    data = armature.animation_data
    track = data.nla_tracks.new()
    track.strips.new("strip", 1, data.action)
    data.action_blend_type = "ADD"
    ask("blended", actions.LCOLLISION_OT_resolve_action)
    data.action_blend_type = "REPLACE"
    action, data.action, data.nla_tracks.active = data.action, None, track
    data.use_tweak_mode = True
    assert data.use_tweak_mode
    ask("tweaked", actions.LCOLLISION_OT_resolve_action)
    data.use_tweak_mode = False
    data.nla_tracks.remove(track)
    data.action = action
    bpy.context.view_layer.update()
    answer["changed"] = [name for name, one in state(armature).items() if one != before[name]]
    return answer


def library(path, folder, constrained):
    """Resolve a character of another file: linked, then overridden; save and open again."""
    armature = inside.load(path)
    hero = bpy.data.collections.new("hero")
    for item in (armature, *inside.meshes_of(armature)):
        for collection in list(item.users_collection):
            collection.objects.unlink(item)
        hero.objects.link(item)
    bpy.context.scene.collection.children.link(hero)
    swing(armature)
    if constrained == "True":
        armature.pose.bones["Head"].constraints.new("LIMIT_ROTATION")
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/library.blend")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    with bpy.data.libraries.load(f"{folder}/library.blend", link=True) as (_, wanted):
        wanted.collections = ["hero"]
    hero = bpy.data.collections["hero"]
    bpy.context.scene.collection.children.link(hero)

    def armature_of(scene):
        return next(one for one in scene.objects if one.type == "ARMATURE" and "." not in one.name)

    def active():
        item = armature_of(bpy.context.scene)
        bpy.context.view_layer.objects.active = item
        bpy.context.scene.frame_set(6)
        bpy.context.view_layer.update()
        return item

    active()
    kinds = {
        "pose": inside.module("operators").LCOLLISION_OT_resolve_pose,
        "action": inside.module("actions").LCOLLISION_OT_resolve_action,
    }
    objects = sorted(bpy.data.objects.keys())
    answer = {name: reported(kind) for name, kind in kinds.items()}
    answer["stray"] = sorted(bpy.data.objects.keys()) != objects
    bpy.context.scene.collection.children.unlink(hero)
    hero.override_hierarchy_create(
        bpy.context.scene, bpy.context.view_layer, do_fully_editable=True
    )
    bpy.context.view_layer.update()
    armature = active()
    assert armature.override_library is not None
    answer["overridden"] = reported(kinds["action"])
    shown = bpy.context.view_layer.objects.active
    answer["shown"] = [shown.name, shown.animation_data.action.name, len(shown.pose.bones)]
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/shot.blend")
    bpy.ops.wm.open_mainfile(filepath=f"{folder}/shot.blend")
    again = bpy.data.objects[answer["shown"][0]]
    answer["reopened"] = [
        again.animation_data.action.name,
        sum(len(bone.constraints) for bone in again.pose.bones),
    ]
    bpy.context.view_layer.objects.active = again
    answer["checked"] = reported(inside.module("actions").LCOLLISION_OT_check_action)[1]
    return answer


def unkeyable(path):
    """Resolve actions with curves that are locked, muted or have a modifier."""
    armature = inside.load(path)
    actions, curves_of = inside.module("actions"), inside.module("keys").curves_of
    swing(armature)
    for name in ("Spine", "RightArm", "Neck"):
        armature.pose.bones[name].keyframe_insert("rotation_quaternion", frame=1)
    armature.pose.bones["RightArm"].keyframe_insert("rotation_quaternion", frame=11)
    curves = {}
    for curve in curves_of(armature.animation_data.action, armature):
        curves.setdefault(curve.data_path.split('"')[1], []).append(curve)
    curves["Spine"][1].lock = True
    curves["Neck"][2].mute = True
    noise = curves["RightArm"][1].modifiers.new("NOISE")
    noise.strength, noise.scale = 0.01, 3.0
    # Between its keys, a cycle equals the curve itself.
    curves["LeftArm"][0].modifiers.new("CYCLES")
    old = inside.keys(armature.animation_data.action, armature)
    answer = {"why": inside.module("keys").unkeyable_bones(rigged(), list(range(1, 12)))}
    answer["said"] = reported(actions.LCOLLISION_OT_resolve_action)
    new = inside.keys(armature.animation_data.action, armature)
    answer["same"] = sorted(
        {name.split('"')[1] for name in old if "rotation" in name and new[name] == old[name]}
    )
    answer["verdict"] = inside.settings().verdict
    return answer


def rigged():
    return inside.module("scene").Rigged.of(bpy.context)


def half(turn):
    """Return half of a turn."""
    whole = Matrix(turn.tolist()).to_quaternion()
    return np.array(Quaternion().slerp(whole, 0.5).to_matrix().to_4x4())


def mirrored(path):
    """Resolve an action of a half body that a modifier mirrors; turn half the way first."""
    armature = inside.load(path)
    inside.mirror(inside.meshes_of(armature)[0])
    swing(armature)
    link, asked = inside.module("link"), []
    send = link.OpenCharacter.send

    def record(self, kind, *arguments, **values):
        asked.append(kind)
        return send(self, kind, *arguments, **values)

    actions = inside.module("actions")
    kind = actions.Turned

    class Half(kind):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            if asked.count("resolve_motion") == 1:
                flat = [half(one) for one in self.turns.reshape(-1, 4, 4)]
                self.turns = np.array(flat).reshape(self.turns.shape)

    link.OpenCharacter.send, actions.Turned = record, Half
    answer = {"said": reported(actions.LCOLLISION_OT_resolve_action)}
    link.OpenCharacter.send, actions.Turned = send, kind
    new = inside.keys(armature.animation_data.action, armature)
    return answer | {
        "verdict": inside.settings().verdict,
        "steps": asked.count("resolve_motion"),
        "keyed": sorted({name.split('"')[1] for name in new}),
    }


def nothing_turns(path):
    """Resolve with every bone locked, with auto-keying."""
    armature = inside.load(path)
    swing(armature)
    for bone in armature.pose.bones:
        bone.lock_rotation = (True, True, True)
    bpy.context.scene.tool_settings.use_keyframe_insert_auto = True
    before = state(armature)
    answer = {"action": reported(inside.module("actions").LCOLLISION_OT_resolve_action)}
    bpy.context.scene.frame_set(6)
    answer["pose"] = reported(inside.module("operators").LCOLLISION_OT_resolve_pose)
    bpy.context.scene.frame_set(0)
    answer["changed"] = [name for name, one in state(armature).items() if one != before[name]]
    return answer


def worse(path):
    """Make the written result worse: in all colliding frames, in one of a span, or by jumps."""
    armature, actions = inside.load(path), inside.module("actions")
    operators, kind = inside.module("operators"), inside.module("scene").Rigged
    swing(armature, ((1, 60.0), (8, 105.0), (15, 60.0), (60, 60.0), (67, 105.0), (74, 60.0)))
    bpy.context.scene.frame_start = 1
    before, answer, shown, first = state(armature), {}, [], {}
    turn, read, show = kind.turn, actions.read_frames, actions.ActionCopy._show
    left, right = (rigged().bones.index(name) for name in ("LeftArm", "RightArm"))
    deeper = deeper_turn(armature, 12.0)

    def turn_deeper(self, transforms, _joints, _turns, by_fk=frozenset()):
        return turn(self, transforms, [left], deeper[None], by_fk)

    def turn_to_and_fro(self, transforms, joints, turns, by_fk=frozenset()):
        number = bpy.context.scene.frame_current
        if number < 40 and number % 2:
            up = np.array(Matrix.Rotation(0.6, 4, (1.0, 0.0, 0.0)))
            # Of two turns of a joint, the last one applies.
            joints, turns = [*joints, right], np.concatenate([turns, up[None]])
        return turn(self, transforms, joints, turns, by_fk)

    def read_more_pairs(*arguments, **options):
        """Report one more pair than before for a freed frame."""
        frames = yield from read(*arguments, **options)
        for at, number in enumerate(frames.numbers):
            if number == 8 and frames.found[at]["colliding"]:
                first.update(frames.found[at])
            elif number == 8:
                frames.found[at] = first | {"pairs": first["pairs"] + 1}
        return frames

    def look(self, *arguments):
        yield from show(self, *arguments)
        colliding = self._frames.colliding
        shown.append(
            [operators.is_worse(self.now.found[at], self._frames.found[at]) for at in colliding]
        )

    def resolve(name):
        armature.animation_data.action = bpy.data.actions[before["action"]]
        answer[name] = spans_of(
            armature, 74, lambda: reported(actions.LCOLLISION_OT_resolve_action)
        )
        answer[name]["changed"] = [
            key for key, one in state(armature).items() if one != before[key]
        ]
        answer[name]["frames"] = [item.frame for item in inside.settings().frames]

    # One step's result is enough here: further ones only cost time.
    most, actions.MOST_STEPS = actions.MOST_STEPS, 1
    kind.turn, actions.ActionCopy._show = turn_deeper, look
    resolve("all")
    answer["shown"], actions.ActionCopy._show = shown, show
    bpy.context.scene.frame_set(6)
    pose = inside.rotations(armature)
    answer["pose"] = reported(operators.LCOLLISION_OT_resolve_pose)
    answer["pose_is_kept"] = inside.rotations(armature) == pose
    kind.turn, actions.read_frames = turn, read_more_pairs
    resolve("one")
    kind.turn, actions.read_frames = turn_to_and_fro, read
    resolve("jump")
    kind.turn, actions.MOST_STEPS = turn, most
    return answer


def deeper_turn(armature, degrees):
    """Return the (4, 4) local turn of the left arm that continues the motion of `swing`."""
    rest = np.array(armature.data.bones["LeftArm"].matrix_local.to_3x3())
    back = armature.matrix_world.inverted().to_3x3() @ Vector((0.0, 1.0, 0.0))
    turn = np.eye(4)
    turn[:3, :3] = rest.T @ np.array(Matrix.Rotation(np.radians(degrees), 3, back)) @ rest
    return turn


if __name__ == "__main__":
    inside.main(globals())

"""Threads change a scene while others draw, select and copy it. Each of these must see
the scene either before or after a change.

Pictures are compared bit for bit with those of scenes that do not change.
"""

import copy
import hashlib
import pickle
import threading

import numpy as np

import v3dg
from fuzz.attacks.pool import Outcome
from random_bundle import random_bundle

LIMIT_S = 60
NUM_DRAWERS = 3
CAMERA = v3dg.Camera.look_at((0, -9, 2), (0, 0, 0), width=48, height=36)


def prepare(shared):
    pass


class Attack:
    def __init__(self, shared):
        self._bundles = [random_bundle(seed, num_levels=3, max_cluster=9) for seed in range(2)]

    def plan(self, rng, work):
        story = rng.choice(STORIES)
        seed = rng.getrandbits(32)

        def do():
            fault = story(np.random.default_rng(seed), self._bundles)
            return Outcome("fault" if fault else "right", fault)

        return story.__name__, do


def _poses(rng, count):
    return {
        "positions": rng.normal(size=(count, 3)) * 2,
        "quaternions": rng.normal(size=(count, 4)),
        "scales": rng.uniform(0.5, 2, count),
    }


def _drawn(scene):
    image = v3dg.render(scene, CAMERA, tolerance=1.0, depth=True, device="cpu")
    planes = (image.color, image.alpha, image.depth)
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(plane).tobytes() for plane in planes)
    ).hexdigest()


def _selected(scene):
    cut = v3dg.select(scene, CAMERA, tolerance=1.0, device="cpu")
    return hashlib.sha256(cut.instance_ids.tobytes() + cut.cluster_ids.tobytes()).hexdigest()


def _of_states(look, states):
    return {look(state) for state in states}


def _scene(bundles, poses):
    """Return half of the instances of each bundle."""
    scene, count = v3dg.Scene(), len(poses["positions"])
    for b, bundle in enumerate(bundles):
        rows = slice(b * count // 2, (b + 1) * count // 2)
        scene.add(bundle, **{name: values[rows] for name, values in poses.items()})
    return scene


def _together(change, looks, num_changes):
    """Return the first fault that a thread observes while the main thread changes the
    scene."""
    ends, faults = threading.Event(), []

    def go_on(look, right):
        try:
            while not ends.is_set() and not faults:
                if look() not in right:
                    faults.append("what was seen is neither the state before nor the one after")
        except Exception as error:
            faults.append(f"{type(error).__name__}: {str(error)[:200]!a}")

    threads = [threading.Thread(target=go_on, args=args, daemon=True) for args in looks]
    for thread in threads:
        thread.start()
    for i in range(num_changes):
        if faults:
            break
        change(i)
    ends.set()
    for thread in threads:
        thread.join()
    return faults[0] if faults else None


def _looks(scene, states):
    """Run threads that draw, select, and use a copy."""
    pictures, cuts = _of_states(_drawn, states), _of_states(_selected, states)
    return [
        *[(lambda: _drawn(scene), pictures)] * NUM_DRAWERS,
        (lambda: _selected(scene), cuts),
    ]


def moved_all(rng, bundles):
    poses = [_poses(rng, 20) for _ in range(2)]
    scene, states = _scene(bundles, poses[0]), [_scene(bundles, p) for p in poses]
    return _together(lambda i: scene.move(**poses[(i + 1) % 2]), _looks(scene, states), 150)


def moved_some(rng, bundles):
    ids = rng.choice(20, 7, replace=False)
    first, second = _poses(rng, 20), _poses(rng, 7)
    scene, states = _scene(bundles, first), [_scene(bundles, first) for _ in range(2)]
    states[1].move(ids, **second)
    ways = [{name: values[ids] for name, values in first.items()}, second]
    # Quaternions are normalised, so an instance that is moved back has the same pose
    # again.
    scene.move(ids, **ways[0])
    states[0].move(ids, **ways[0])
    return _together(lambda i: scene.move(ids, **ways[(i + 1) % 2]), _looks(scene, states), 150)


def importance_changed(rng, bundles):
    poses, ways = _poses(rng, 20), rng.uniform(0.1, 9, (2, 20))
    states = [_scene(bundles, poses) for _ in range(2)]
    scene = _scene(bundles, poses)
    for state, importance in zip((*states, scene), (*ways, ways[0]), strict=True):
        state.set_importance(importance)
    return _together(lambda i: scene.set_importance(ways[(i + 1) % 2]), _looks(scene, states), 150)


def added_and_removed(rng, bundles):
    poses, more = _poses(rng, 20), _poses(rng, 5)
    states = [_scene(bundles, poses) for _ in range(2)]
    states[1].add(bundles[0], **more)
    scene = _scene(bundles, poses)

    def change(i):
        if i % 2:
            scene.remove(range(20, 25))
        else:
            scene.add(bundles[0], **more)

    return _together(change, _looks(scene, states), 150)


def added_by_many(rng, bundles):
    """No instance is lost, and each can be drawn."""
    scene, poses = v3dg.Scene(), [_poses(rng, 3) for _ in range(40)]
    start, faults, ids = threading.Barrier(4), [], []

    def add(mine):
        start.wait()
        try:
            for i, pose in enumerate(mine):
                ids.extend(scene.add(bundles[i % 2], **pose))
        except Exception as error:
            faults.append(f"{type(error).__name__}: {str(error)[:200]!a}")

    threads = [threading.Thread(target=add, args=(poses[t::4],)) for t in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if faults:
        return faults[0]
    if len(scene) != 120 or len(scene.positions) != 120 or sorted(ids) != list(range(120)):
        return f"expected 120 instances, got {len(scene)}, with {len(scene.positions)} positions"
    expected = np.concatenate([pose["positions"] for pose in poses])
    if not (np.sort(expected, axis=0) == np.sort(scene.positions, axis=0)).all():
        return "other instances than were added"
    _drawn(scene)
    return None


def moved_by_many(rng, bundles):
    """Each thread moves its own instances.

    At the end, all instances are where they were moved to.
    """
    poses, last = _poses(rng, 20), _poses(rng, 20)
    scene, expected = _scene(bundles, poses), _scene(bundles, last)

    def move(rows):
        for i in range(40):
            pose = last if i == 39 else poses
            scene.move(rows, **{name: values[rows] for name, values in pose.items()})

    threads = [threading.Thread(target=move, args=(list(range(t, 20, 4)),)) for t in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    is_right = all(
        (getattr(scene, name) == getattr(expected, name)).all()
        for name in ("positions", "quaternions", "scales")
    )
    return None if is_right and _drawn(scene) == _drawn(expected) else "a move was lost"


def copied_while_it_changes(rng, bundles):
    poses = [_poses(rng, 20) for _ in range(2)]
    scene, states = _scene(bundles, poses[0]), [_scene(bundles, p) for p in poses]
    ways = (
        lambda: _drawn(copy.copy(scene)),
        lambda: _drawn(copy.deepcopy(scene)),
        lambda: _drawn(pickle.loads(pickle.dumps(scene))),
    )
    right = _of_states(_drawn, states)
    return _together(lambda i: scene.move(**poses[(i + 1) % 2]), [(way, right) for way in ways], 60)


def copies_are_apart(rng, bundles):
    """A change of a copy does not change the scene; a selection can be pickled with its
    scene."""
    poses = _poses(rng, 20)
    scene = _scene(bundles, poses)
    before, cut = _drawn(scene), _selected(scene)
    for copied in (copy.copy(scene), copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        if _drawn(copied) != before:
            return "a copy looks different"
        copied.move(positions=poses["positions"] + 1)
        copied.add(bundles[1])
        copied.remove([0])
        if _drawn(scene) != before:
            return "a change of a copy changes the scene"
    selection = pickle.loads(pickle.dumps(v3dg.select(scene, CAMERA, tolerance=1.0, device="cpu")))
    image = v3dg.render(selection.scene, CAMERA, cut=selection, device="cpu")
    return (
        None
        if _selected(selection.scene) == cut and image.color.shape
        else "a selection is another after a pickle"
    )


def cut_outlives_its_instances(rng, bundles):
    """A cut of removed instances is refused, or draws what it selected."""
    scene = _scene(bundles, _poses(rng, 20))
    cut = v3dg.select(scene, CAMERA, tolerance=1.0, device="cpu")
    changes = [
        lambda: scene.remove(rng.choice(20, 3, replace=False)),
        lambda: scene.add(bundles[int(rng.integers(2))], **_poses(rng, 4)),
    ]
    for i in rng.permutation(2):
        changes[i]()
    try:
        v3dg.render(scene, CAMERA, cut=cut, device="cpu")
    except ValueError as error:
        return None if "cut" in str(error) else f"{str(error)[:200]!a}"
    return "a cut was drawn of instances that are others now"


STORIES = (
    moved_all,
    moved_some,
    importance_changed,
    added_and_removed,
    added_by_many,
    moved_by_many,
    copied_while_it_changes,
    copies_are_apart,
    cut_outlives_its_instances,
)

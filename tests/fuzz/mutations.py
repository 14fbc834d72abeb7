"""Changes that keep a document valid JSON, which random changes of bytes rarely do."""

import json

VALUES = (
    *(
        None,
        True,
        False,
        0,
        1,
        -1,
        0.5,
        2,
        3,
        1e-300,
        1e300,
        1 << 20,
        1 << 31,
        1 << 63,
        1 << 64,
        10**400,
    ),
    *(
        "",
        "a",
        "x",
        "v3dg",
        "v3dg-scene",
        "OPENCV",
        "\ud800",
        "..",
        [],
        {},
        [0, 0, 0],
        [1, 0, 0, 0],
        [[]],
    ),
)


def changed_json(text, rng):
    """Return the document of the text with one value or key changed, or the text itself
    if it is no document."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return text
    places = list(_places(document))
    if places:
        container, key = rng.choice(places)
        action = rng.randrange(5)
        if action == 0:
            del container[key]
        elif action == 1:
            other, other_key = rng.choice(places)
            container[key] = json.loads(json.dumps(other[other_key]))
        elif action == 2 and isinstance(container, list):
            container.insert(key, json.loads(json.dumps(container[key])))
        elif action == 3 and isinstance(container, dict):
            container[rng.choice(places)[1]] = container.pop(key)
        else:
            container[key] = rng.choice(VALUES)
    return json.dumps(document).encode()


def _places(value):
    """Yield every value in the document, as its container and its key."""
    keys = (
        value.keys()
        if isinstance(value, dict)
        else range(len(value))
        if isinstance(value, list)
        else ()
    )
    for key in keys:
        yield value, key
        yield from _places(value[key])

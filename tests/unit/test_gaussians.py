import pickle
import re

import numpy as np
import pytest

from v3dg import Camera, Gaussians, rasterize

NAMES = ("means", "quats", "scales", "opacities", "sh")


def random_arrays(num: int, degree: int = 1, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = {"means": (num, 3), "quats": (num, 4), "scales": (num, 3), "opacities": (num,)}
    shapes["sh"] = (num, (degree + 1) ** 2, 3)
    return {name: rng.uniform(0.1, 1, shape).astype(np.float32) for name, shape in shapes.items()}


def random_gaussians(num: int, degree: int = 1, seed: int = 0) -> Gaussians:
    return Gaussians(**random_arrays(num, degree, seed))


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name in NAMES:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("num", [0, 1, 5])
def test_knows_its_length_and_degree(num, degree):
    gaussians = random_gaussians(num, degree)
    assert len(gaussians) == num
    assert gaussians.sh_degree == degree
    assert repr(gaussians) == f"Gaussians({num}, sh_degree={degree}, numpy)"


def test_holds_the_arrays_it_was_given():
    arrays = random_arrays(5)
    gaussians = Gaussians(**arrays)
    for name in NAMES:
        assert getattr(gaussians, name) is arrays[name]


def test_survives_pickling():
    gaussians = random_gaussians(5)
    assert_same(pickle.loads(pickle.dumps(gaussians)), gaussians)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"means": [[0, 0, 0]]},
            TypeError,
            "means: expected a NumPy array or a torch tensor, got list",
        ),
        ({"sh": None}, TypeError, "sh: expected a NumPy array or a torch tensor, got NoneType"),
        ({"means": np.zeros(5, np.float32)}, ValueError, "means: expected shape (N, 3), got (5,)"),
        (
            {"means": np.zeros((5, 4), np.float32)},
            ValueError,
            "means: expected shape (N, 3), got (5, 4)",
        ),
        (
            {"quats": np.zeros((4, 4), np.float32)},
            ValueError,
            "quats: expected shape (5, 4) to match means of shape (5, 3), got (4, 4)",
        ),
        (
            {"opacities": np.zeros((5, 1), np.float32)},
            ValueError,
            "opacities: expected shape (5,) to match means of shape (5, 3), got (5, 1)",
        ),
        (
            {"sh": np.zeros((5, 5, 3), np.float32)},
            ValueError,
            "sh: expected shape (5, K, 3) with K = 1, 4, 9 or 16, got (5, 5, 3)",
        ),
        (
            {"sh": np.zeros((5, 3), np.float32)},
            ValueError,
            "sh: expected shape (5, K, 3) with K = 1, 4, 9 or 16, got (5, 3)",
        ),
        (
            {"scales": np.zeros((5, 3))},
            ValueError,
            "scales: expected dtype float32, got float64; convert it",
        ),
        (
            {"scales": np.zeros((5, 3), ">f4")},
            ValueError,
            "scales: expected dtype float32, got >f4",
        ),
        (
            {"means": np.zeros((3, 5), np.float32).T},
            ValueError,
            "means: expected a C-contiguous array, got a",
        ),
    ],
)
def test_refuses_wrong_arrays(change, error, message):
    with pytest.raises(error, match=re.escape(message)):
        Gaussians(**{**random_arrays(5), **change})


@pytest.mark.parametrize(
    "index",
    [
        slice(None),
        slice(1, 3),
        slice(None, None, 2),
        slice(None, None, -1),
        slice(7, 9),
        [4, 0, 0, -1],
        np.array([3, 1], np.uint8),
        np.array([True, False, True, False, True]),
        [],
    ],
    ids=str,
)
def test_subset_takes_the_rows_in_order(index):
    gaussians = random_gaussians(5)
    taken = gaussians.subset(index)
    rows = np.arange(5)[np.array(index, int) if isinstance(index, list) else index]
    for name in NAMES:
        np.testing.assert_array_equal(getattr(taken, name), getattr(gaussians, name)[rows])


@pytest.mark.gpu
def test_subset_on_a_cuda_device():
    import torch

    gaussians = random_gaussians(5, degree=1)
    there = gaussians.torch("cuda")
    for index in ([4, 0, -1], [], [True, False, True, True, False]):
        expected = gaussians.subset(index)
        for kind in (index, np.array(index), torch.tensor(index), torch.tensor(index).cuda()):
            if len(index) or isinstance(kind, list):
                taken = there.subset(kind)
                assert taken.means.is_cuda
                assert_same(taken.numpy(), expected)
    for wrong in ([5], [-6], [True] * 4):
        with pytest.raises(IndexError):
            there.subset(torch.tensor(wrong).cuda())


def test_subset_by_a_plain_slice_shares_memory():
    gaussians = random_gaussians(5)
    assert np.shares_memory(gaussians.subset(slice(1, 4)).sh, gaussians.sh)


@pytest.mark.parametrize(
    ("index", "error", "message"),
    [
        (3, TypeError, "index: expected a slice, integers or booleans, got int"),
        (
            [0.5],
            TypeError,
            "index: expected a slice, integers or booleans, got list of dtype float64",
        ),
        ([[0, 1]], ValueError, "index: expected one dimension, got shape (1, 2)"),
        ([5], IndexError, "5"),
        ([True] * 4, IndexError, "4"),
    ],
)
def test_subset_refuses_what_is_no_index(index, error, message):
    with pytest.raises(error, match=re.escape(message)):
        random_gaussians(5).subset(index)


def test_concatenate_undoes_subset():
    gaussians = random_gaussians(7, degree=2)
    parts = [gaussians.subset(slice(a, b)) for a, b in ((0, 3), (3, 3), (3, 7))]
    assert_same(Gaussians.concatenate(parts), gaussians)


@pytest.mark.parametrize(
    ("parts", "error", "message"),
    [
        ([], ValueError, "parts: expected at least one Gaussians, got none"),
        ([random_gaussians(1), 3], TypeError, "parts[1]: expected Gaussians, got int"),
        (
            [random_gaussians(1, 0), random_gaussians(1, 3)],
            ValueError,
            "parts[1]: expected SH degree 0 like parts[0], got 3",
        ),
    ],
)
def test_concatenate_refuses_what_does_not_fit(parts, error, message):
    with pytest.raises(error, match=re.escape(message)):
        Gaussians.concatenate(parts)


def test_numpy_of_numpy_is_itself():
    gaussians = random_gaussians(2)
    assert gaussians.numpy() is gaussians


def test_torch_and_numpy_share_memory():
    pytest.importorskip("torch")
    gaussians = random_gaussians(4)
    tensors = gaussians.torch()
    assert repr(tensors) == "Gaussians(4, sh_degree=1, torch cpu)"
    back = tensors.numpy()
    assert_same(back, gaussians)
    for name in NAMES:
        assert np.shares_memory(getattr(back, name), getattr(gaussians, name))


def test_read_only_arrays_become_tensors_by_copy():
    pytest.importorskip("torch")
    arrays = random_arrays(4)
    for array in arrays.values():
        array.flags.writeable = False
    assert_same(Gaussians(**arrays).torch().numpy(), Gaussians(**arrays))


def test_tensors_keep_their_gradients():
    torch = pytest.importorskip("torch")
    tensors = random_gaussians(4).torch()
    tensors.means.requires_grad_()
    twice = Gaussians.concatenate([tensors, tensors.subset([1, 1])])
    twice.means.sum().backward()
    assert torch.equal(tensors.means.grad[:, 0], torch.tensor([1.0, 3.0, 1.0, 1.0]))
    assert len(tensors.numpy()) == 4  # a tensor with a gradient is accepted


@pytest.mark.parametrize(
    "index",
    [slice(1, 3), slice(None, None, -2), [2, 0], np.array([True, False, True, False])],
    ids=str,
)
def test_subset_of_tensors_is_that_of_arrays(index):
    torch = pytest.importorskip("torch")
    gaussians = random_gaussians(4)
    taken = gaussians.torch().subset(index)
    assert isinstance(taken.means, torch.Tensor)
    assert_same(taken.numpy(), gaussians.subset(index))
    if not isinstance(index, slice):
        as_tensor = torch.from_numpy(np.array(index))
        assert_same(gaussians.torch().subset(as_tensor).numpy(), gaussians.subset(as_tensor))


def test_refuses_a_mixture_of_kinds():
    torch = pytest.importorskip("torch")
    arrays = random_arrays(4)
    with pytest.raises(
        TypeError, match="sh: expected a NumPy array like the other arrays, got a torch tensor"
    ):
        Gaussians(**{**arrays, "sh": torch.from_numpy(arrays["sh"])})
    with pytest.raises(
        TypeError, match=r"parts\[1\]\.means: expected a NumPy array like the other arrays"
    ):
        Gaussians.concatenate([Gaussians(**arrays), Gaussians(**arrays).torch()])


@pytest.mark.parametrize(
    ("sh", "message"),
    [
        (
            lambda torch: torch.zeros(4, 4, 3, dtype=torch.float64),
            "sh: expected dtype float32, got float64",
        ),
        (
            lambda torch: torch.zeros(3, 4, 4).T,
            "sh: expected a contiguous tensor, got a strided one",
        ),
        (
            lambda torch: torch.zeros(4, 4, 3, device="meta"),
            "sh: expected device cpu like the other arrays, got meta",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:The use of `x.T`")
def test_refuses_wrong_tensors(sh, message):
    torch = pytest.importorskip("torch")
    tensors = {name: torch.from_numpy(array) for name, array in random_arrays(4).items()}
    with pytest.raises(ValueError, match=re.escape(message)):
        Gaussians(**{**tensors, "sh": sh(torch)})


def test_double_precision_tensors_are_drawn_in_double_precision():
    torch = pytest.importorskip("torch")
    g = Gaussians(
        means=torch.zeros(1, 3, dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        scales=torch.full((1, 3), 0.3, dtype=torch.float64),
        opacities=torch.full((1,), 0.7, dtype=torch.float64),
        sh=torch.ones(1, 1, 3, dtype=torch.float64, requires_grad=True),
    )
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), width=8, height=8)
    color = rasterize(g, camera).color
    assert color.dtype == torch.float64
    color.sum().backward()
    assert g.sh.grad.abs().sum() > 0

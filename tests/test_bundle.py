import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from random_bundle import random_bundle
from v3dg.bundle import Bundle

ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh")
some_bundles = st.builds(
    random_bundle,
    st.integers(0, 2**32 - 1),
    num_levels=st.integers(0, 5),
    sh_degree=st.integers(0, 3),
    max_cluster=st.sampled_from([0, 1, 5, 200]),
)


def assert_same_gaussians(a, b):
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)


@settings(max_examples=60)
@given(bundle=some_bundles)
def test_what_is_saved_is_opened(tmp_path_factory, bundle):
    path = tmp_path_factory.mktemp("round_trip") / "a.v3dg"
    bundle.save(path)
    opened = Bundle.open(path)
    for table in ("clusters", "groups"):
        for name, array in vars(getattr(bundle, table)).items():
            np.testing.assert_array_equal(array, getattr(getattr(opened, table), name), strict=True)
    for cluster in range(len(bundle.clusters)):
        assert_same_gaussians(bundle.cluster_gaussians(cluster), opened.cluster_gaussians(cluster))
    for level in range(bundle.num_levels):
        assert_same_gaussians(bundle.level_gaussians(level), opened.level_gaussians(level))
    assert_same_gaussians(bundle.gaussians, opened.gaussians)
    assert opened.config == bundle.config

#include <algorithm>
#include <functional>
#include <vector>

#include "bindings/operations.h"
#include "bindings/types.h"
#include "gather/gather.h"

namespace v3dg {

namespace {

// The clusters that are asked for, each with rows of its instance's bundle.
void check_clusters(const GatherInput& in) {
    if (in.offset[0] != 0) throw py::value_error("offset: expected boundaries from 0");
    for (size_t s = 0; s < in.instance.size; ++s) {
        const int32_t i = in.instance[s];
        if (i < 0 || static_cast<size_t>(i) >= in.bundle.size)
            throw py::value_error("instance: expected one below " + std::to_string(in.bundle.size) +
                                  ", got " + std::to_string(i));
        const auto rows = static_cast<int64_t>(in.bundles[in.bundle[i]].size);
        const int64_t size = in.offset[s + 1] - in.offset[s];
        if (size < 0 || in.first_row[s] < 0 || in.first_row[s] > rows - size)
            throw py::value_error("first_row, offset: expected rows of the bundle, cluster " +
                                  std::to_string(s) + " has others");
    }
}

py::tuple gather(const std::vector<std::reference_wrapper<const Rows>>& bundles, const Instances& instances,
                 const py::array& instance, const py::array& first_row, const py::array& offset,
                 const py::object& weights, int device) {
    std::vector<GaussianRows<const float>> rows;
    int sh_degree = 0;
    for (const Rows& bundle : bundles) {
        if (bundle.device() != Device{device})
            throw py::value_error("bundles: expected gaussians on the device that is asked for, got others");
        rows.push_back(bundle.read<float>());
        sh_degree = std::max(sh_degree, bundle.sh_degree());
    }
    instances.check_bundles(rows.size());
    const InstanceTable& placed = instances.table();
    GatherInput in;
    in.bundles = {rows.data(), rows.size()};
    in.bundle = placed.bundle;
    in.position = placed.position;
    in.quaternion = placed.quaternion;
    in.scale = placed.scale;
    in.instance = span_of<const int32_t>(instance, "instance", {-1});
    const auto num_clusters = static_cast<py::ssize_t>(in.instance.size);
    in.first_row = span_of<const int64_t>(first_row, "first_row", {num_clusters});
    in.offset = span_of<const int64_t>(offset, "offset", {num_clusters + 1});
    if (!weights.is_none()) in.weight = span_of<const float>(weights, "weights", {num_clusters});
    check_clusters(in);
    const Work work(Device{device});
    const NewRows out(Device{device}, static_cast<size_t>(in.offset[in.instance.size]), sh_degree);
    {
        const py::gil_scoped_release unlocked;
        V3DG_DISPATCH(work, gather, in, out.rows());
    }
    return out.arrays();
}

}  // namespace

void bind_gather(py::module_& m) {
    m.def("gather", &gather, py::kw_only(), "bundles"_a, "instances"_a, "instance"_a, "first_row"_a,
          "offset"_a, "weights"_a = py::none(), "device"_a,
          "Gaussians of clusters of instances in the world: means, quats, scales, opacities, sh.");
}

}  // namespace v3dg

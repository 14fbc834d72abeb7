// Binds the operations that gather and rotate gaussians to Python.

#include <algorithm>
#include <functional>
#include <vector>

#include "bindings/backend.h"
#include "bindings/operations.h"

namespace v3dg {

namespace {

// Checks the requested clusters. Their instances must exist, and their rows must be in
// the instances' bundles.
void check_clusters(const GatherInput& in) {
    if (in.offset[0] != 0)
        throw py::value_error("offset: expected 0 as the first number, got " +
                              std::to_string(in.offset[0]));
    for (size_t s = 0; s < in.instance.size; ++s) {
        const int32_t i = in.instance[s];
        if (i < 0 || static_cast<size_t>(i) >= in.bundle.size)
            throw py::value_error("instance: expected an index below " +
                                  std::to_string(in.bundle.size) + ", got " + std::to_string(i));
        const auto rows = static_cast<int64_t>(in.bundles[in.bundle[i]].size);
        const int64_t size = in.offset[s + 1] - in.offset[s];
        if (size < 0 || in.first_row[s] < 0 || in.first_row[s] > rows - size)
            throw py::value_error(
                "first_row, offset: expected rows of the bundle, got other rows for "
                "cluster " +
                std::to_string(s));
    }
}

py::tuple gathered(const GatherInput& in, Device device, int sh_degree) {
    const Work work(device);
    const NewRows out(device, static_cast<size_t>(in.offset[in.instance.size]), sh_degree);
    {
        const Unlocked unlocked;
        work.backend().gather(in, out.rows(), work);
    }
    return out.arrays();
}

py::tuple gather(const std::vector<std::reference_wrapper<const Rows>>& bundles,
                 const Instances& instances, const py::array& instance, const py::array& first_row,
                 const py::array& offset, const py::object& weights, int device) {
    std::vector<GaussianRows<const float>> rows;
    int sh_degree = 0;
    for (const Rows& bundle : bundles) {
        if (bundle.device() != Device{device})
            throw py::value_error(
                "bundles: expected gaussians on the requested device, got some on another device");
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
    in.factors = placed.factors;
    in.instance = span_of<const int32_t>(instance, "instance", {-1});
    const auto num_clusters = static_cast<py::ssize_t>(in.instance.size);
    in.first_row = span_of<const int64_t>(first_row, "first_row", {num_clusters});
    in.offset = span_of<const int64_t>(offset, "offset", {num_clusters + 1});
    if (!weights.is_none()) in.weight = span_of<const float>(weights, "weights", {num_clusters});
    check_clusters(in);
    return gathered(in, Device{device}, sh_degree);
}

// Transforms all gaussians of a bundle, as a single cluster of a single instance.
py::tuple transform(const Rows& rows, const py::array& quaternion, const py::array& position,
                    double scale) {
    const GaussianRows<const float> bundle = rows.read<float>();
    const int32_t first = 0;
    const int64_t first_row = 0, offset[] = {0, static_cast<int64_t>(bundle.size)};
    GatherInput in;
    in.bundles = {&bundle, 1};
    in.bundle = in.instance = {&first, 1};
    in.position = span_of<const double>(position, "position", {3});
    in.quaternion = span_of<const double>(quaternion, "quaternion", {4});
    in.scale = {&scale, 1};
    in.first_row = {&first_row, 1};
    in.offset = {offset, 2};
    return gathered(in, rows.device(), rows.sh_degree());
}

}  // namespace

void bind_gather(py::module_& m) {
    m.def("gather", &gather, py::kw_only(), "bundles"_a, "instances"_a, "instance"_a, "first_row"_a,
          "offset"_a, "weights"_a = py::none(), "device"_a,
          "Returns the gaussians of clusters of instances, in world coordinates: means, quats, "
          "scales, opacities, sh.");
    m.def("transform", &transform, "rows"_a, "quaternion"_a, "position"_a, "scale"_a,
          "Returns gaussians after the transform p -> scale * rotation p + position.");
}

}  // namespace v3dg

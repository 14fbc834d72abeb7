#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "bindings/args.h"
#include "project/project_math.h"
#include "select/select.h"

namespace v3dg {

namespace {

// A bundle's table with the arrays that it borrows from.
class BoundTable {
  public:
    BoundTable(py::array ball, py::array weight, py::array own_group, py::array parent_group, py::array box,
               py::array filter_px2, py::array offset)
        : arrays_{ball, weight, own_group, parent_group, box, filter_px2, offset} {
        const Span<const float> balls = span_of<const float>(ball, "ball", {-1, 4});
        const size_t num_groups = balls.size / 4;
        const Span<const float> weights =
            span_of<const float>(weight, "weight", {static_cast<py::ssize_t>(num_groups)});
        const Span<const int32_t> own = span_of<const int32_t>(own_group, "own_group", {-1});
        const py::ssize_t num_clusters = static_cast<py::ssize_t>(own.size);
        const Span<const int32_t> parent =
            span_of<const int32_t>(parent_group, "parent_group", {num_clusters});
        const Span<const float> boxes = span_of<const float>(box, "box", {num_clusters, 2, 3});
        const Span<const float> filters = span_of<const float>(filter_px2, "filter_px2", {num_clusters});
        const Span<const int64_t> offsets = span_of<const int64_t>(offset, "offset", {num_clusters + 1});
        check_groups(own, "own_group", num_groups);
        check_groups(parent, "parent_group", num_groups);

        table_.ball = {reinterpret_cast<const Ball*>(balls.data), num_groups};
        table_.weight = weights;
        table_.own_group = own;
        table_.parent_group = parent;
        table_.box = {reinterpret_cast<const Box*>(boxes.data), own.size};
        table_.offset = offsets;
        find_top();
        find_bounds();
        float filter = 0.0f;
        for (const float value : filters) filter = std::max(filter, value);
        table_.pad_px = static_cast<float>(kReachSigmas) * std::sqrt(filter) + 1.0f;
    }

    BoundTable(const BoundTable&) = delete;

    const ClusterTable& table() const { return table_; }

  private:
    static void check_groups(Span<const int32_t> groups, const char* name, size_t num_groups) {
        for (const int32_t g : groups)
            if (g < -1 || (g >= 0 && static_cast<size_t>(g) >= num_groups))
                throw py::value_error(std::string(name) + ": expected -1 or a group below " +
                                      std::to_string(num_groups) + ", got " + std::to_string(g));
    }

    void find_top() {
        std::vector<uint8_t> is_top(table_.ball.size, 0);
        for (size_t c = 0; c < table_.parent_group.size; ++c) {
            if (table_.parent_group[c] >= 0) continue;
            top_cluster_.push_back(static_cast<int32_t>(c));
            if (table_.own_group[c] >= 0) is_top[table_.own_group[c]] = 1;
        }
        for (size_t g = 0; g < is_top.size(); ++g)
            if (is_top[g]) top_group_.push_back(static_cast<int32_t>(g));
        table_.top_group = {top_group_.data(), top_group_.size()};
        table_.top_cluster = {top_cluster_.data(), top_cluster_.size()};
    }

    // A box that is not a number makes the bounds so: nothing of the instance is ever dropped.
    void find_bounds() {
        constexpr float kInfinity = std::numeric_limits<float>::infinity();
        table_.bounds = {{kInfinity, kInfinity, kInfinity}, {-kInfinity, -kInfinity, -kInfinity}};
        for (const Box& box : table_.box)
            for (int a = 0; a < 3; ++a) {
                if (!(table_.bounds.lo[a] <= box.lo[a])) table_.bounds.lo[a] = box.lo[a];
                if (!(table_.bounds.hi[a] >= box.hi[a])) table_.bounds.hi[a] = box.hi[a];
            }
    }

    std::vector<py::array> arrays_;
    std::vector<int32_t> top_group_, top_cluster_;
    ClusterTable table_;
};

Footprint footprint_of(const std::string& name) {
    if (name == "solid_angle") return Footprint::solid_angle;
    if (name == "paper") return Footprint::paper;
    throw py::value_error("footprint: expected solid_angle or paper, got " + name);
}

// Arguments of one selection; `tables` and `input` borrow from them.
struct Arguments {
    std::vector<ClusterTable> tables;
    SelectInput input;
};

Arguments arguments_of(const py::list& tables, const py::array& instance_bundle, const py::array& positions,
                       const py::array& rotations, const py::array& scales, const py::array& viewmat,
                       const py::array& eye, const py::array& K, double width, double height, double near,
                       double tolerance, const std::string& footprint) {
    Arguments arguments;
    for (const py::handle table : tables) arguments.tables.push_back(table.cast<const BoundTable&>().table());
    SelectInput& input = arguments.input;
    const Span<const int32_t> bundle = span_of<const int32_t>(instance_bundle, "instance_bundle", {-1});
    const py::ssize_t count = static_cast<py::ssize_t>(bundle.size);
    for (const int32_t b : bundle)
        if (b < 0 || static_cast<size_t>(b) >= arguments.tables.size())
            throw py::value_error("instance_bundle: expected a bundle below " +
                                  std::to_string(arguments.tables.size()) + ", got " + std::to_string(b));
    input.instances = {bundle, span_of<const double>(positions, "positions", {count, 3}),
                       span_of<const double>(rotations, "rotations", {count, 3, 3}),
                       span_of<const double>(scales, "scales", {count})};
    const Span<const double> view = span_of<const double>(viewmat, "viewmat", {4, 4});
    const Span<const double> position = span_of<const double>(eye, "eye", {3});
    const Span<const double> intrinsics = span_of<const double>(K, "K", {3, 3});
    SelectCamera& camera = input.camera;
    for (int row = 0; row < 3; ++row) {
        camera.eye[row] = position[row];
        for (int k = 0; k < 3; ++k) camera.rotation[3 * row + k] = view[4 * row + k];
    }
    camera.fx = intrinsics[0];
    camera.fy = intrinsics[4];
    camera.cx = intrinsics[2];
    camera.cy = intrinsics[5];
    camera.width = width;
    camera.height = height;
    camera.near = near;
    input.rule = {static_cast<float>(camera.fx * camera.fy), static_cast<float>(tolerance),
                  footprint_of(footprint), false};
    return arguments;
}

int num_cuda_devices() {
    if constexpr (V3DG_WITH_CUDA) return cuda::num_devices();
    return 0;
}

template <class T>
py::array_t<T> array_of(const std::vector<T>& values) {
    return py::array_t<T>(static_cast<py::ssize_t>(values.size()), values.data());
}

py::tuple select(const py::list& tables, const py::array& instance_bundle, const py::array& positions,
                 const py::array& rotations, const py::array& scales, const py::array& viewmat,
                 const py::array& eye, const py::array& K, double width, double height, double near,
                 double tolerance, const std::string& footprint, bool cull, const std::string& device) {
    Arguments arguments = arguments_of(tables, instance_bundle, positions, rotations, scales, viewmat, eye, K,
                                       width, height, near, tolerance, footprint);
    SelectInput& input = arguments.input;
    input.bundles = {arguments.tables.data(), arguments.tables.size()};
    input.rule.culls = cull;
    SelectOutput output;
    if (device == "cpu") {
        const py::gil_scoped_release unlocked;
        cpu::select(input, output);
    } else if (device == "cuda") {
        if constexpr (V3DG_WITH_CUDA) {
            if (num_cuda_devices() == 0)
                throw std::runtime_error(
                    "device: expected a CUDA device and its driver, found none; use cpu");
            const py::gil_scoped_release unlocked;
            cuda::select(input, output);
        } else {
            throw std::runtime_error(
                "device: v3dg was built without CUDA; use cpu, or install it again where nvcc is found");
        }
    } else {
        throw py::value_error("device: expected cpu or cuda, got " + device);
    }
    return py::make_tuple(array_of(output.instance), array_of(output.cluster), output.num_gaussians);
}

py::tuple group_metrics(const py::list& tables, const py::array& instance_bundle, const py::array& positions,
                        const py::array& rotations, const py::array& scales, const py::array& viewmat,
                        const py::array& eye, const py::array& K, double width, double height, double near,
                        const std::string& footprint) {
    Arguments arguments = arguments_of(tables, instance_bundle, positions, rotations, scales, viewmat, eye, K,
                                       width, height, near, 0.0, footprint);
    SelectInput& input = arguments.input;
    input.bundles = {arguments.tables.data(), arguments.tables.size()};
    const Span<const int32_t> bundle = input.instances.bundle;
    py::array_t<int64_t> offset(static_cast<py::ssize_t>(bundle.size + 1));
    const Span<int64_t> offsets{offset.mutable_data(), bundle.size + 1};
    offsets[0] = 0;
    for (size_t i = 0; i < bundle.size; ++i)
        offsets[i + 1] = offsets[i] + static_cast<int64_t>(arguments.tables[bundle[i]].ball.size);
    py::array_t<float> metric(static_cast<py::ssize_t>(offsets[bundle.size]));
    const Span<float> metrics{metric.mutable_data(), static_cast<size_t>(metric.size())};
    {
        const py::gil_scoped_release unlocked;
        cpu::group_metrics(input, offsets, metrics);
    }
    return py::make_tuple(metric, offset);
}

}  // namespace

void bind_select(py::module_& m) {
    using namespace py::literals;
    py::class_<BoundTable>(m, "ClusterTable", "What selection reads of a bundle; borrows the arrays.")
        .def(py::init<py::array, py::array, py::array, py::array, py::array, py::array, py::array>(),
             "ball"_a, "weight"_a, "own_group"_a, "parent_group"_a, "box"_a, "filter_px2"_a, "offset"_a);
    m.def("num_cuda_devices", &num_cuda_devices, "CUDA devices to run on; 0 without CUDA or a driver.");
    m.def("select", &select, "tables"_a, "instance_bundle"_a, "positions"_a, "rotations"_a, "scales"_a,
          "viewmat"_a, "eye"_a, "K"_a, "width"_a, "height"_a, "near"_a, "tolerance"_a, "footprint"_a,
          "cull"_a, "device"_a,
          "Clusters that one view needs: (instance (S,) int32, cluster (S,) int32, number of gaussians).");
    m.def("group_metrics", &group_metrics, "tables"_a, "instance_bundle"_a, "positions"_a, "rotations"_a,
          "scales"_a, "viewmat"_a, "eye"_a, "K"_a, "width"_a, "height"_a, "near"_a, "footprint"_a,
          "Metric of every group of every instance, px2, and where each instance's metrics begin.");
}

}  // namespace v3dg

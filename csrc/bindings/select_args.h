#pragma once

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "bindings/args.h"
#include "bindings/render_args.h"
#include "math/gaussian.h"
#include "select/select.h"

namespace v3dg {

// A bundle's table with the arrays that it borrows from.
class BoundTable {
  public:
    BoundTable(py::array ball, py::array weight, py::array level, py::array own_group, py::array parent_group,
               py::array box, py::array filter_px2, py::array offset)
        : arrays_{ball, weight, level, own_group, parent_group, box, filter_px2, offset} {
        const Span<const float> balls = span_of<const float>(ball, "ball", {-1, 4});
        const size_t num_groups = balls.size / 4;
        const Span<const float> weights =
            span_of<const float>(weight, "weight", {static_cast<py::ssize_t>(num_groups)});
        const Span<const int32_t> levels =
            span_of<const int32_t>(level, "level", {static_cast<py::ssize_t>(num_groups)});
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
        table_.level = levels;
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

    void find_bounds() {
        table_.bounds = no_box();
        for (const Box& box : table_.box) grow(table_.bounds, box);
    }

    std::vector<py::array> arrays_;
    std::vector<int32_t> top_group_, top_cluster_;
    ClusterTable table_;
};

inline Footprint footprint_of(const std::string& name) {
    if (name == "solid_angle") return Footprint::solid_angle;
    if (name == "paper") return Footprint::paper;
    throw py::value_error("footprint: expected solid_angle or paper, got " + name);
}

// Of (viewmat (4, 4), K (3, 3), width, height, near, window). A window (x0, y0, x1, y1) is a part of the
// image, or None.
inline Camera select_camera(const py::tuple& t) {
    const py::array viewmat = t[0].cast<py::array>(), K = t[1].cast<py::array>();
    const Span<const double> view = span_of<const double>(viewmat, "viewmat", {4, 4});
    const Span<const double> intrinsics = span_of<const double>(K, "K", {3, 3});
    Camera camera;
    for (int row = 0; row < 3; ++row)
        for (int k = 0; k < 3; ++k) camera.rotation[3 * row + k] = view[4 * row + k];
    eye_of(view.data, camera.eye);
    camera.fx = intrinsics[0];
    camera.fy = intrinsics[4];
    camera.cx = intrinsics[2];
    camera.cy = intrinsics[5];
    const int width = t[2].cast<int>(), height = t[3].cast<int>();
    camera.width = width;
    camera.height = height;
    camera.near = t[4].cast<double>();
    std::array<int, 4> w{0, 0, width, height};
    if (!t[5].is_none()) w = t[5].cast<std::array<int, 4>>();
    if (!(0 <= w[0] && w[0] < w[2] && w[2] <= width && 0 <= w[1] && w[1] < w[3] && w[3] <= height))
        throw py::value_error("window: expected x0 < x1 and y0 < y1 within " + std::to_string(width) + " x " +
                              std::to_string(height) + " px, got " +
                              py::str(py::cast(w)).cast<std::string>());
    camera.x0 = w[0];
    camera.y0 = w[1];
    camera.x1 = w[2];
    camera.y1 = w[3];
    return camera;
}

inline std::array<double, 5> intrinsics_of(const Camera& c) { return {c.fx, c.fy, c.cx, c.cy, c.near}; }
inline Pinhole<float> pinhole_of(const Camera& c) {
    return pinhole_of<float>(intrinsics_of(c), static_cast<int>(c.width), static_cast<int>(c.height));
}

// Of (tolerance, budget or None, min_level, footprint, cull).
inline SelectRule select_rule(const py::tuple& t) {
    SelectRule rule;
    rule.tolerance_px2 = static_cast<float>(t[0].cast<double>());
    if (!t[1].is_none()) rule.budget = t[1].cast<uint64_t>();
    rule.min_level = t[2].cast<int32_t>();
    rule.footprint = footprint_of(t[3].cast<std::string>());
    rule.culls = t[4].cast<bool>();
    return rule;
}

inline Span<const int32_t> bundle_of_instance(const py::array& array, size_t num_bundles) {
    const Span<const int32_t> bundle = span_of<const int32_t>(array, "instance_bundle", {-1});
    for (const int32_t b : bundle)
        if (b < 0 || static_cast<size_t>(b) >= num_bundles)
            throw py::value_error("instance_bundle: expected a bundle below " + std::to_string(num_bundles) +
                                  ", got " + std::to_string(b));
    return bundle;
}

// Borrows the arrays of a scene's instances: (bundle (I,), positions (I, 3), quaternions (I, 4), scales (I,),
// importance (I,)).
inline InstanceTable instance_table(const py::tuple& t, size_t num_bundles) {
    const Span<const int32_t> bundle = bundle_of_instance(t[0].cast<py::array>(), num_bundles);
    const py::ssize_t count = static_cast<py::ssize_t>(bundle.size);
    return {bundle, span_of<const double>(t[1].cast<py::array>(), "positions", {count, 3}),
            span_of<const double>(t[2].cast<py::array>(), "quaternions", {count, 4}),
            span_of<const double>(t[3].cast<py::array>(), "scales", {count}),
            span_of<const float>(t[4].cast<py::array>(), "importance", {count})};
}

template <class T>
py::array_t<T> array_of(const std::vector<T>& values) {
    return py::array_t<T>(static_cast<py::ssize_t>(values.size()), values.data());
}
inline py::tuple tuple_of(const SelectOutput& out) {
    return py::make_tuple(array_of(out.instance), array_of(out.cluster), out.num_gaussians, out.tolerance_px2,
                          out.fits_budget);
}

}  // namespace v3dg

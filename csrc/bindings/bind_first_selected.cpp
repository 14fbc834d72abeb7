// Bindings that compute how much the balls of level 1 must grow. They draw pictures of
// levels 0 and 1, and compare them.

#include <algorithm>

#include "bindings/backend.h"
#include "bindings/operations.h"
#include "levels/first_selected.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {

namespace {

constexpr std::array<double, 3> kWhite{1, 1, 1}, kBlack{0, 0, 0};

// The colours of a picture on white.
struct Colors {
    py::object object;
    Span<const float> span;

    Colors(const Rows& gaussians, const Camera& camera, const DrawLook& look)
        : object(backend_of(gaussians.device())
                     .to_host(rasterize(gaussians, {{}, camera}, look, false, false).color)),
          span(span_of<const float>(object, "color",
                                    {py::ssize_t(camera.height), py::ssize_t(camera.width), 3})) {}
};

// Returns the gaussians with black colour, of SH degree 0.
Rows blackened(const Rows& gaussians) {
    const NewArray<float> sh({}, {py::ssize_t(gaussians.size()), 1, 3});
    std::fill(sh.span.begin(), sh.span.end(), 0.0f);
    const std::array<py::object, 5>& arrays = gaussians.arrays();
    const Backend& backend = backend_of(gaussians.device());
    return {arrays[0], arrays[1], arrays[2], arrays[3],
            backend.from_host(sh.object, gaussians.device())};
}

py::array first_selected(const Rows& leaves, const Rows& level, const py::array& leaf_offset,
                         const py::array& group_offset, const py::array& ball,
                         double leaf_filter_px2, bool leaf_antialiased, double level_filter_px2) {
    const Device device = leaves.device();
    const Backend& backend = backend_of(device);
    const auto num_leaves = static_cast<py::ssize_t>(leaves.size());
    const Span<const int64_t> of_leaves = offsets_of(leaf_offset, leaves.size()),
                              of_level = offsets_of(group_offset, level.size());
    const auto num_groups = static_cast<py::ssize_t>(of_level.size) - 1;
    if (num_groups < 1 || of_leaves.size != of_level.size)
        throw py::value_error(
            "leaf_offset, group_offset: expected boundaries of the same groups, got " +
            std::to_string(of_leaves.size) + " and " + std::to_string(of_level.size) + " numbers");
    const Span<const float> balls = span_of<const float>(ball, "ball", {num_groups, 4});
    const py::object means = backend.to_host(leaves.arrays()[0]);
    FirstSelected measured(span_of<const float>(means, "means", {num_leaves, 3}),
                           {reinterpret_cast<const Ball*>(balls.data), size_t(num_groups)},
                           of_level);
    const Rows black = blackened(leaves);
    const DrawLook own{.filter_px2 = leaf_filter_px2,
                       .antialiased = leaf_antialiased,
                       .background = kWhite,
                       .plain_colors = false};
    const DrawLook coarse{.filter_px2 = level_filter_px2,
                          .antialiased = true,
                          .background = kWhite,
                          .plain_colors = false};
    DrawLook in_black = own;
    in_black.background = kBlack;
    in_black.plain_colors = true;
    for (size_t picture = 0; picture < FirstSelected::num_pictures(); ++picture) {
        if (PyErr_CheckSignals() != 0) throw py::error_already_set();
        const Camera camera = measured.camera(picture);
        const auto width = static_cast<size_t>(camera.width),
                   height = static_cast<size_t>(camera.height);
        const Colors truth(leaves, camera.scaled(FirstSelected::kSamples), own),
            by_leaves(leaves, camera, own), by_level(level, camera, coarse);
        const NewArray<float> losses({}, {py::ssize_t(height), py::ssize_t(width), 3});
        {
            const Unlocked unlocked;
            losses_of_pixels({by_leaves.span, by_level.span, truth.span}, width, height,
                             losses.span);
        }
        // Distribute the losses of pixels over the leaves in proportion to their blend
        // weights. This distribution equals the derivative of the sum of loss * colour
        // with respect to the leaves' colours.
        const Rasterized seen = rasterize(black, {{}, camera}, in_black, false, true);
        const Gradients gradients =
            seen.tape->backward(backend.from_host(losses.object, device), py::none(), py::none(),
                                {.sum = false, .size = false});
        const py::object shares = backend.to_host(gradients.sh);
        measured.add(picture, span_of<const float>(shares, "sh", {num_leaves, 1, 3}), of_leaves);
    }
    const std::vector<float> growth = measured.growth();
    return py::array_t<float>(num_groups, growth.data());
}

// Multiplies the balls of level 1 by `growth`, and enlarges those of higher levels so
// that they contain the balls below. Returns the balls of all levels. Level 0 does not
// change.
py::list grown_balls(const py::list& balls, const py::array& growth) {
    py::list grown;
    std::vector<Ball> below;
    for (const py::handle& level : balls) {
        if (grown.empty()) {
            grown.append(level);
            continue;
        }
        const Span<const float> given = span_of<const float>(level, "balls", {-1, 4});
        const NewArray<float> array({}, {py::ssize_t(given.size / 4), 4});
        const Span<Ball> here{reinterpret_cast<Ball*>(array.span.data), given.size / 4};
        if (below.empty()) {
            std::copy(given.begin(), given.end(), array.span.begin());
            const Span<const float> times =
                span_of<const float>(growth, "growth", {py::ssize_t(here.size)});
            for (size_t g = 0; g < here.size; ++g) here[g].radius *= times[g];
        } else {
            if (here.size == 0 || below.size() % here.size != 0)
                throw py::value_error(
                    "balls: expected a count that divides the count of the level below, got " +
                    std::to_string(here.size) + " and " + std::to_string(below.size()));
            std::vector<int64_t> offset;
            for (size_t g = 0; g <= here.size; ++g)
                offset.push_back(static_cast<int64_t>(g * (below.size() / here.size)));
            cpu::bound_spheres({below.data(), below.size()}, {offset.data(), offset.size()},
                               kNestingMargin, here);
        }
        below.assign(here.begin(), here.end());
        grown.append(array.object);
    }
    return grown;
}

}  // namespace

void bind_first_selected(py::module_& m) {
    m.def("first_selected", &first_selected, "leaves"_a, "level"_a, "leaf_offset"_a,
          "group_offset"_a, "ball"_a, "leaf_filter_px2"_a, "leaf_antialiased"_a,
          "level_filter_px2"_a,
          "Returns the factors by which the balls of level 1 must grow. Then its groups are "
          "selected only where they look as good as their leaves at one sample per pixel.");
    m.def("grown_balls", &grown_balls, "balls"_a, "growth"_a,
          "Multiplies the radii of the balls of level 1 by the factors, and enlarges the balls of "
          "higher levels to contain them. Returns the balls of all levels.");
}

}  // namespace v3dg

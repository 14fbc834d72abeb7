#include "bindings/args.h"
#include "bindings/device_args.h"
#include "cluster/box.h"

namespace v3dg {

using namespace py::literals;

static Span<const int64_t> clusters_of(const py::array& offset, size_t count) {
    const Span<const int64_t> offsets = span_of<const int64_t>(offset, "offset", {-1});
    bool good = offsets.size > 0 && offsets[0] == 0 && offsets[offsets.size - 1] == int64_t(count);
    for (size_t c = 1; good && c < offsets.size; ++c) good = offsets[c - 1] <= offsets[c];
    if (!good)
        throw py::value_error("offset: expected ascending boundaries from 0 to " + std::to_string(count) +
                              ", got others");
    return offsets;
}

static Span<Box> boxes_of(Span<float> values) {
    return {reinterpret_cast<Box*>(values.data), values.size / 6};
}

void bind_box(py::module_& m) {
    m.def(
        "bound_by_boxes",
        [](const py::array& means, const py::array& quats, const py::array& scales, const py::array& offset) {
            const Span<const float> centers = span_of<const float>(means, "means", {-1, 3});
            const py::ssize_t count = static_cast<py::ssize_t>(centers.size / 3);
            const BoxInput in{centers.data, span_of<const float>(quats, "quats", {count, 4}).data,
                              span_of<const float>(scales, "scales", {count, 3}).data,
                              clusters_of(offset, centers.size / 3)};
            py::array_t<float> box(
                {static_cast<py::ssize_t>(in.offset.size - 1), py::ssize_t(2), py::ssize_t(3)});
            const Span<Box> out = boxes_of({box.mutable_data(), static_cast<size_t>(box.size())});
            {
                const py::gil_scoped_release unlocked;
                cpu::bound_by_boxes(in, out);
            }
            return box;
        },
        "means"_a, "quats"_a, "scales"_a, "offset"_a,
        "Lower and upper corner of what each cluster draws: (C, 2, 3).");
    if constexpr (V3DG_WITH_CUDA)
        m.def(
            "bound_by_boxes_cuda",
            [](const py::object& means, const py::object& quats, const py::object& scales,
               const py::array& offset, const py::object& box, uintptr_t stream) {
                const Span<const float> centers = device_span_of<const float>(means, "means", {-1, 3});
                const py::ssize_t count = static_cast<py::ssize_t>(centers.size / 3);
                const BoxInput in{centers.data, device_span_of<const float>(quats, "quats", {count, 4}).data,
                                  device_span_of<const float>(scales, "scales", {count, 3}).data,
                                  clusters_of(offset, centers.size / 3)};
                const Span<Box> out = boxes_of(
                    device_span_of<float>(box, "box", {static_cast<py::ssize_t>(in.offset.size - 1), 2, 3}));
                const py::gil_scoped_release unlocked;
                cuda::bound_by_boxes(in, out, reinterpret_cast<cuda::Stream>(stream));
            },
            "means"_a, "quats"_a, "scales"_a, "offset"_a, "box"_a, "stream"_a,
            "The same on a device: fills `box`.");
}

}  // namespace v3dg

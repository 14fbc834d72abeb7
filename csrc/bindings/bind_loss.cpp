#include <algorithm>

#include "bindings/args.h"
#include "fit_group/dssim.h"

namespace v3dg {

using namespace py::literals;

void bind_loss(py::module_& m) {
    m.def(
        "dssim",
        [](const py::array& picture, const py::array& target) {
            const Span<const float> p = span_of<const float>(picture, "picture", {-1, -1});
            const py::ssize_t height = picture.shape(0), width = picture.shape(1);
            const Span<const float> t = span_of<const float>(target, "target", {height, width});
            if (p.size == 0) throw py::value_error("picture: expected at least one pixel, got none");
            py::array_t<float> gradient({height, width});
            std::fill_n(gradient.mutable_data(), gradient.size(), 0.0f);
            SsimScratch scratch;
            const float value = dssim(p.data, t.data, static_cast<int>(width), static_cast<int>(height), 1.0f,
                                      gradient.mutable_data(), scratch);
            return py::make_tuple(value, gradient);
        },
        "picture"_a, "target"_a, "Mean of 1 - SSIM of one channel, and its gradient by the picture.");
}

}  // namespace v3dg

#include "bindings/args.h"

#if V3DG_WITH_CUDA

#include "bindings/frame_args.h"
#include "pipeline/frame_backward.h"

namespace v3dg {

using namespace py::literals;

// What rasterize_cuda leaves for rasterize_backward_cuda.
struct TapeCuda {
    std::unique_ptr<cuda::DifferentiableFrame> frame;
    py::ssize_t size, sh_bases, width, height;

    ~TapeCuda() { cuda::give_back(std::move(frame)); }
};

static std::shared_ptr<TapeCuda> rasterize_cuda(const py::tuple& gaussians,
                                                const std::array<double, 15>& view, double filter_px2,
                                                bool compensate, const std::array<double, 5>& k,
                                                const std::array<double, 3>& background,
                                                const py::tuple& picture, uintptr_t stream) {
    const GaussianRows<const float> model = rows_of(gaussians);
    const cuda::FrameImage image = image_of(k, background, picture);
    const cuda::ModelPicture in{model, view_of<float>(view.data()), static_cast<float>(filter_px2),
                                compensate, image};
    py::gil_scoped_release unlocked;
    std::unique_ptr<cuda::DifferentiableFrame> frame = cuda::take_frame();
    frame->draw(in, stream_of(stream));
    return std::shared_ptr<TapeCuda>(new TapeCuda{std::move(frame), static_cast<py::ssize_t>(model.size),
                                                  num_sh_bases(model.sh_degree), image.width, image.height});
}

static void rasterize_backward_cuda(const TapeCuda& tape, const py::object& d_color,
                                    const py::object& d_alpha, const py::object& d_depth,
                                    const py::tuple& d_gaussians, const py::object& d_background,
                                    uintptr_t stream) {
    const py::ssize_t n = tape.size, h = tape.height, w = tape.width;
    const PictureGradient<float> d_picture{
        device_span_of<const float>(d_color, "d_color", {h, w, 3}).data,
        device_span_of<const float>(d_alpha, "d_alpha", {h, w}).data,
        d_depth.is_none() ? nullptr : device_span_of<const float>(d_depth, "d_depth", {h, w}).data};
    const GaussianRows<float> out{device_span_of<float>(d_gaussians[0], "d_means", {n, 3}).data,
                                  device_span_of<float>(d_gaussians[1], "d_quats", {n, 4}).data,
                                  device_span_of<float>(d_gaussians[2], "d_scales", {n, 3}).data,
                                  device_span_of<float>(d_gaussians[3], "d_opacities", {n}).data,
                                  device_span_of<float>(d_gaussians[4], "d_sh", {n, tape.sh_bases, 3}).data,
                                  static_cast<size_t>(n),
                                  degree_of_bases(tape.sh_bases, "")};
    float* background = device_span_of<float>(d_background, "d_background", {3}).data;
    py::gil_scoped_release unlocked;
    tape.frame->backward(d_picture, out, background, stream_of(stream));
}

void bind_rasterize_cuda(py::module_& m) {
    py::class_<TapeCuda, std::shared_ptr<TapeCuda>>(
        m, "TapeCuda", "What rasterize_cuda leaves for rasterize_backward_cuda.");
    m.def("rasterize_cuda", &rasterize_cuda, "gaussians"_a, "view"_a, "filter_px2"_a, "compensate"_a,
          "intrinsics"_a, "background"_a, "picture"_a, "stream"_a,
          "Fills the picture (color, alpha, depth). The way back reads it and the gaussians again.");
    m.def("rasterize_backward_cuda", &rasterize_backward_cuda, "tape"_a, "d_color"_a, "d_alpha"_a,
          "d_depth"_a, "d_gaussians"_a, "d_background"_a, "stream"_a,
          "Fills d_gaussians (means, ..., sh) and d_background.");
}

}  // namespace v3dg

#else

void v3dg::bind_rasterize_cuda(py::module_&) {}

#endif

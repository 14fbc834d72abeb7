#include <algorithm>

#include "bindings/operations.h"
#include "bindings/picture.h"
#include "bindings/tape.h"
#include "draw/model.h"
#include "draw/render.h"
#include "project/ellipses.h"

#if V3DG_WITH_CUDA
#include "draw/render_backward_cuda.h"
#endif

namespace v3dg {

namespace {

// It, or nothing where it is not wanted.
template <class T>
struct NewCenters {
    py::object sum = py::none(), size = py::none();
    CenterGradients<T> spans{};

    NewCenters(Centers wanted, Device device, py::ssize_t count) {
        if (wanted.sum) spans.sum = add(device, count, sum);
        if (wanted.size) spans.size = reinterpret_cast<CenterSize<T>*>(add(device, count, size));
    }

  private:
    static T* add(Device device, py::ssize_t count, py::object& object) {
        const NewArray<T> array(device, {count, 2});
        object = array.object;
        if (device.is_host()) std::fill(array.span.begin(), array.span.end(), T(0));
        return array.span.data;
    }
};

// The gradient of a plane of the picture; where none is given, zeros.
template <class T>
struct Plane {
    py::object object;
    Span<const T> span;

    Plane(const py::object& given, const char* name, Device device,
          const std::vector<py::ssize_t>& shape)
        : object(given.is_none() ? zeros(device, shape) : given) {
        span = shape.size() == 3
                   ? span_on<const T>(device, object, name, {shape[0], shape[1], shape[2]})
                   : span_on<const T>(device, object, name, {shape[0], shape[1]});
    }

  private:
    static py::object zeros(Device device, const std::vector<py::ssize_t>& shape) {
        const py::object array = new_array(device, py::dtype::of<T>(), shape);
        if (device.is_host())
            array.attr("fill")(0);
        else
            array.attr("zero_")();
        return array;
    }
};

template <class T>
class HostTape final : public Tape {
  public:
    HostTape(const GaussianRows<const T>& rows, const BoundCamera& camera, const Look& look)
        : model_(rows),
          draw_{&model_.planes(),
                0,
                model_.size(),
                view_of_world<T>(camera.camera),
                {T(look.filter_px2), look.antialiased, false}},
          camera_(camera.camera.intrinsics<T>()),
          height_(camera.height()),
          width_(camera.width()),
          background_(look.background) {}

    RenderCounts draw(const Picture<T>& picture, bool keeps_tape) {
        return render<T>({draw_}, camera_, picture, keeps_tape, workspace_);
    }

    py::tuple backward(const py::object& d_color, const py::object& d_alpha,
                       const py::object& d_depth, Centers wanted) override {
        const py::ssize_t h = height_, w = width_;
        const Plane<T> color(d_color, "d_color", {}, {h, w, 3}),
            alpha(d_alpha, "d_alpha", {}, {h, w});
        const PictureGradient<T> d_picture{
            color.span.data, alpha.span.data,
            d_depth.is_none() ? nullptr : span_of<const T>(d_depth, "d_depth", {h, w}).data};
        const auto n = static_cast<py::ssize_t>(model_.size());
        const int degree = model_.planes().sh_degree;
        const NewArray<T> means({}, {n, 3}), quats({}, {n, 4}), scales({}, {n, 3}),
            opacities({}, {n}), sh({}, {n, num_sh_bases(degree), 3}), background({}, {3});
        for (const Span<T>& span :
             {means.span, quats.span, scales.span, opacities.span, sh.span, background.span})
            std::fill(span.begin(), span.end(), T(0));
        const NewCenters<T> centers(wanted, {}, n);
        const GaussianRows<T> out{
            means.span.data, quats.span.data, scales.span.data, opacities.span.data, sh.span.data,
            model_.size(),   degree};
        {
            const Unlocked unlocked;
            const Picture<T> picture{{0, 0, width_, height_},
                                     {T(background_[0]), T(background_[1]), T(background_[2])},
                                     nullptr,
                                     nullptr,
                                     nullptr};
            render_backward<T>(draw_, camera_, picture, d_picture, workspace_, out, centers.spans,
                               background.span.data);
        }
        return py::make_tuple(means.object, quats.object, scales.object, opacities.object,
                              sh.object, background.object, centers.sum, centers.size);
    }

  private:
    Model<T> model_;
    Draw<T> draw_;
    Intrinsics<T> camera_;
    int height_, width_;
    std::array<double, 3> background_;
    Workspace<T> workspace_;
};

py::dict dict_of(const RenderCounts& c) {
    return py::dict("in_frustum"_a = c.in_frustum, "records"_a = c.records, "entries"_a = c.entries,
                    "project_seconds"_a = c.project_seconds, "bin_seconds"_a = c.bin_seconds,
                    "rasterize_seconds"_a = c.rasterize_seconds);
}

template <class T>
py::tuple rasterize_on_host(const Rows& gaussians, const BoundCamera& camera, const Look& look,
                            bool with_depth, bool keep_tape) {
    NewPicture out{camera.height(), camera.width(), {}, {}, py::none(), with_depth};
    const Picture<T> picture =
        out.on_host<T>({0, 0, camera.width(), camera.height()}, Shade{look.background});
    const GaussianRows<const T> rows = look.read<T>(gaussians);
    std::unique_ptr<HostTape<T>> tape;
    RenderCounts counts;
    {
        const Unlocked unlocked;
        tape = std::make_unique<HostTape<T>>(rows, camera, look);
        counts = tape->draw(picture, keep_tape);
    }
    return py::make_tuple(
        out.color, out.alpha, out.depth, dict_of(counts),
        keep_tape ? py::cast(std::unique_ptr<Tape>(std::move(tape))) : py::object(py::none()));
}

#if V3DG_WITH_CUDA

class DeviceTape final : public Tape {
  public:
    // Keeps the arrays, which backward() reads again.
    DeviceTape(const Rows& gaussians, std::unique_ptr<cuda::DifferentiableFrame> frame,
               py::ssize_t height, py::ssize_t width)
        : gaussians_(gaussians), frame_(std::move(frame)), height_(height), width_(width) {}
    ~DeviceTape() override { cuda::give_back(std::move(frame_)); }

    py::tuple backward(const py::object& d_color, const py::object& d_alpha,
                       const py::object& d_depth, Centers wanted) override {
        const py::ssize_t h = height_, w = width_;
        const Device device = gaussians_.device();
        const Work work(device);
        const Plane<float> color(d_color, "d_color", device, {h, w, 3}),
            alpha(d_alpha, "d_alpha", device, {h, w});
        const PictureGradient<float> d_picture{
            color.span.data, alpha.span.data,
            d_depth.is_none() ? nullptr
                              : span_on<const float>(device, d_depth, "d_depth", {h, w}).data};
        const NewRows gradients(device, gaussians_.size(), gaussians_.sh_degree());
        const NewArray<float> background(device, {3});
        const NewCenters<float> centers(wanted, device,
                                        static_cast<py::ssize_t>(gaussians_.size()));
        {
            const Unlocked unlocked;
            frame_->backward(d_picture, gradients.rows(), centers.spans, background.span.data,
                             work.stream());
        }
        return py::tuple(gradients.arrays() +
                         py::make_tuple(background.object, centers.sum, centers.size));
    }

  private:
    Rows gaussians_;
    std::unique_ptr<cuda::DifferentiableFrame> frame_;
    py::ssize_t height_, width_;
};

py::tuple rasterize_on_device(const Rows& gaussians, const BoundCamera& camera, const Look& look,
                              bool with_depth, bool keep_tape) {
    const Device device = gaussians.device();
    const Work work(device);
    NewPicture out{camera.height(), camera.width(), {}, {}, py::none(), with_depth};
    const cuda::ModelPicture in{
        look.read<float>(gaussians), view_of_world<float>(camera.camera),
        static_cast<float>(look.filter_px2), look.antialiased,
        out.frame_image(camera.camera, Shade{look.background}, out.on_device(device))};
    std::unique_ptr<cuda::DifferentiableFrame> frame;
    {
        const Unlocked unlocked;
        frame = cuda::take_frame();
        frame->draw(in, work.stream());
    }
    auto tape = std::make_unique<DeviceTape>(gaussians, std::move(frame), out.height, out.width);
    return py::make_tuple(
        out.color, out.alpha, out.depth, py::none(),
        keep_tape ? py::cast(std::unique_ptr<Tape>(std::move(tape))) : py::object(py::none()));
}

#endif

template <class T>
py::tuple ellipses_of(const Rows& gaussians, const Camera& camera, double filter_px2,
                      bool antialiased, double far_depth, double min_radius_px) {
    const Work work(gaussians.device());
    const auto n = static_cast<py::ssize_t>(gaussians.size());
    const NewArray<T> centers(work.device(), {n, 2}), depths(work.device(), {n}),
        conics(work.device(), {n, 3}), opacities(work.device(), {n});
    const NewArray<int32_t> radii(work.device(), {n, 2});
    const Ellipses<T> out{centers.span.data, depths.span.data, conics.span.data,
                          opacities.span.data, radii.span.data};
    const EllipsesInput<T> in{gaussians.read<T>(),
                              view_of_world<T>(camera),
                              camera.intrinsics<T>(),
                              T(filter_px2),
                              antialiased,
                              T(far_depth),
                              T(min_radius_px)};
    {
        const Unlocked unlocked;
        if constexpr (std::is_same<T, float>::value)
            V3DG_DISPATCH(work, ellipses, in, out);
        else
            cpu::ellipses(in, out);
    }
    return py::make_tuple(centers.object, depths.object, conics.object, opacities.object,
                          radii.object);
}

py::tuple ellipses(const Rows& gaussians, const BoundCamera& camera, double filter_px2,
                   bool antialiased, double far_depth, double min_radius_px) {
    return gaussians.is_double() ? ellipses_of<double>(gaussians, camera.camera, filter_px2,
                                                       antialiased, far_depth, min_radius_px)
                                 : ellipses_of<float>(gaussians, camera.camera, filter_px2,
                                                      antialiased, far_depth, min_radius_px);
}

}  // namespace

py::tuple rasterize(const Rows& gaussians, const BoundCamera& camera, const Look& look,
                    bool with_depth, bool keep_tape) {
    if (look.plain_colors && gaussians.sh_degree() != 0)
        throw py::value_error("sh: expected shape (N, 1, 3) for plain colours, got degree " +
                              std::to_string(gaussians.sh_degree()));
#if V3DG_WITH_CUDA
    if (!gaussians.device().is_host())
        return rasterize_on_device(gaussians, camera, look, with_depth, keep_tape);
#endif
    return gaussians.is_double()
               ? rasterize_on_host<double>(gaussians, camera, look, with_depth, keep_tape)
               : rasterize_on_host<float>(gaussians, camera, look, with_depth, keep_tape);
}

void bind_rasterize(py::module_& m) {
    py::class_<Tape>(m, "Tape",
                     "What rasterize leaves for rasterize_backward; it keeps the gaussians.");
    m.def(
        "rasterize",
        [](const Rows& gaussians, const BoundCamera& camera, double filter_px2, bool antialiased,
           const std::array<double, 3>& background, bool with_depth, bool keep_tape,
           bool plain_colors) {
            const Look look{filter_px2, antialiased, background, plain_colors};
            return rasterize(gaussians, camera, look, with_depth, keep_tape);
        },
        "gaussians"_a, "camera"_a, py::kw_only(), "filter_px2"_a, "antialiased"_a, "background"_a,
        "with_depth"_a, "keep_tape"_a, "plain_colors"_a = false,
        "Draws gaussians where they are and in the precision that they have: (color, alpha, depth "
        "or None, "
        "on "
        "the host counts and times, the tape or None).");
    m.def(
        "rasterize_backward",
        [](Tape& tape, const py::object& d_color, const py::object& d_alpha,
           const py::object& d_depth, bool with_centers, bool with_sizes) {
            return tape.backward(d_color, d_alpha, d_depth, {with_centers, with_sizes});
        },
        "tape"_a, "d_color"_a, "d_alpha"_a, "d_depth"_a, "with_centers"_a = false,
        "with_sizes"_a = false,
        "Gradients of means, quats, scales, opacities, sh and background; by the gaussians' "
        "centres on the "
        "image their sum and the sum of their sizes, where they are wanted.");
    m.def("ellipses", &ellipses, "gaussians"_a, "camera"_a, py::kw_only(), "filter_px2"_a,
          "antialiased"_a, "far_depth"_a, "min_radius_px"_a,
          "Where gaussians lie on the image: centres, depths, conics, opacities, radii; zeros for "
          "those that "
          "are not in sight.");
}

}  // namespace v3dg

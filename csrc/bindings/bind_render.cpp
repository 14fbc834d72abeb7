#include <algorithm>
#include <atomic>
#include <memory>
#include <utility>

#include "bindings/select_args.h"
#include "pipeline/model.h"
#include "pipeline/render.h"

namespace v3dg {

using namespace py::literals;

template <class T>
static std::shared_ptr<Model<T>> make_model(const py::array& means, const py::array& quats,
                                            const py::array& scales, const py::array& opacities,
                                            const py::array& sh) {
    const py::ssize_t n = opacities.ndim() == 1 ? opacities.shape(0) : -1;
    const py::ssize_t bases = sh.ndim() == 3 ? sh.shape(1) : -1;
    const int degree = degree_of_bases(bases, shape_text(sh));
    const GaussianRows<const T> rows{span_of<const T>(means, "means", {n, 3}).data,
                                     span_of<const T>(quats, "quats", {n, 4}).data,
                                     span_of<const T>(scales, "scales", {n, 3}).data,
                                     span_of<const T>(opacities, "opacities", {n}).data,
                                     span_of<const T>(sh, "sh", {n, bases, 3}).data,
                                     static_cast<size_t>(n),
                                     degree};
    py::gil_scoped_release unlocked;
    return std::make_shared<Model<T>>(rows);
}

template <class T>
struct PictureArrays {
    py::array_t<T> color, alpha, depth;
    Picture<T> picture;
    PictureArrays(const Window& window, const std::array<double, 3>& background, bool with_depth)
        : color({window.height(), window.width(), 3}),
          alpha({window.height(), window.width()}),
          depth({with_depth ? window.height() : 0, with_depth ? window.width() : 0}) {
        picture = {window,
                   {T(background[0]), T(background[1]), T(background[2])},
                   color.mutable_data(),
                   alpha.mutable_data(),
                   with_depth ? depth.mutable_data() : nullptr};
    }
    py::object depth_or_none() const { return picture.depth == nullptr ? py::none() : py::object(depth); }
};

// x0, y0, x1, y1.
static py::dict dict_of(const RenderCounts& c) {
    return py::dict("in_frustum"_a = c.in_frustum, "records"_a = c.records, "entries"_a = c.entries,
                    "project_seconds"_a = c.project_seconds, "bin_seconds"_a = c.bin_seconds,
                    "rasterize_seconds"_a = c.rasterize_seconds);
}

// What rasterize leaves for rasterize_backward.
template <class T>
struct Tape {
    std::shared_ptr<Model<T>> model;
    Draw<T> draw;
    Pinhole<T> camera;
    int width, height;
    std::array<double, 3> background;
    Workspace<T> workspace;
};

template <class T>
static py::tuple rasterize(std::shared_ptr<Model<T>> model, const std::array<double, 15>& view,
                           double filter_px2, bool compensate, const std::array<double, 5>& k, int width,
                           int height, const std::array<double, 3>& background, bool with_depth,
                           bool keep_tape) {
    auto tape = std::make_shared<Tape<T>>();
    tape->model = model;
    tape->draw = {&model->planes(), 0, model->size(), view_of<T>(view.data()), T(filter_px2), compensate};
    tape->camera = pinhole_of<T>(k, width, height);
    tape->width = width;
    tape->height = height;
    tape->background = background;
    PictureArrays<T> out({0, 0, width, height}, background, with_depth);
    RenderCounts counts;
    {
        py::gil_scoped_release unlocked;
        counts = render<T>({tape->draw}, tape->camera, out.picture, keep_tape, tape->workspace);
    }
    return py::make_tuple(out.color, out.alpha, out.depth_or_none(), dict_of(counts),
                          keep_tape ? py::cast(tape) : py::object(py::none()));
}

template <class T>
static py::tuple rasterize_backward(const Tape<T>& tape, const py::array& d_color, const py::array& d_alpha,
                                    const py::object& d_depth) {
    const py::ssize_t h = tape.height, w = tape.width;
    const PictureGradient<T> d_picture{
        span_of<const T>(d_color, "d_color", {h, w, 3}).data,
        span_of<const T>(d_alpha, "d_alpha", {h, w}).data,
        d_depth.is_none() ? nullptr : span_of<const T>(py::array(d_depth), "d_depth", {h, w}).data};
    const py::ssize_t n = static_cast<py::ssize_t>(tape.model->size());
    const py::ssize_t bases = num_sh_bases(tape.model->planes().sh_degree);
    const auto zeros = [](std::vector<py::ssize_t> shape) {
        py::array_t<T> a(std::move(shape));
        std::fill_n(a.mutable_data(), a.size(), T(0));
        return a;
    };
    py::array_t<T> means = zeros({n, 3}), quats = zeros({n, 4}), scales = zeros({n, 3}),
                   opacities = zeros({n}), sh = zeros({n, bases, 3}), background = zeros({3});
    const GaussianRows<T> out{means.mutable_data(),          quats.mutable_data(), scales.mutable_data(),
                              opacities.mutable_data(),      sh.mutable_data(),    static_cast<size_t>(n),
                              tape.model->planes().sh_degree};
    T* d_background = background.mutable_data();
    {
        py::gil_scoped_release unlocked;
        const Picture<T> picture{{0, 0, tape.width, tape.height},
                                 {T(tape.background[0]), T(tape.background[1]), T(tape.background[2])},
                                 nullptr,
                                 nullptr,
                                 nullptr};
        render_backward<T>(tape.draw, tape.camera, picture, d_picture, tape.workspace, out, d_background);
    }
    return py::make_tuple(means, quats, scales, opacities, sh, background);
}

// A workspace lent to one caller at a time, kept from frame to frame; a second caller gets one of its own.
// Without a lock, which a fork() in the middle would leave closed.
class SharedWorkspace {
  public:
    ~SharedWorkspace() { delete kept_.load(); }
    std::unique_ptr<Workspace<float>> take() {
        std::unique_ptr<Workspace<float>> kept(kept_.exchange(nullptr));
        return kept ? std::move(kept) : std::make_unique<Workspace<float>>();
    }
    // Keeps what the next frame is likely to need, but does not sit on the memory of an exceptional one.
    void give_back(std::unique_ptr<Workspace<float>> workspace) {
        constexpr size_t kMostRecords = size_t(16) << 20;
        if (workspace->records.capacity() <= kMostRecords)
            workspace.reset(kept_.exchange(workspace.release()));
    }

  private:
    std::atomic<Workspace<float>*> kept_{nullptr};
};

// The clusters of one bundle as render_selection needs them.
struct BundleClusters {
    std::shared_ptr<Model<float>> model;
    Span<const int64_t> offset;
    Span<const float> filter_px2;
    Span<const uint8_t> compensate;
};

static BundleClusters clusters_of(const py::handle& item) {
    const py::tuple t = item.cast<py::tuple>();
    const py::array offset = t[1].cast<py::array>();
    const py::ssize_t c = offset.ndim() == 1 ? offset.shape(0) - 1 : 0;
    return {t[0].cast<std::shared_ptr<Model<float>>>(), span_of<const int64_t>(offset, "offset", {c + 1}),
            span_of<const float>(t[2].cast<py::array>(), "filter_px2", {c}),
            span_of<const uint8_t>(t[3].cast<py::array>(), "antialiased", {c})};
}

// The clusters of a selection as draws. Neighbouring clusters of one instance are neighbours in memory: one
// draw.
struct SelectionDraws {
    std::vector<BundleClusters> tables;  // which keep the models
    std::vector<Draw<float>> draws;
    std::vector<uint64_t> last_gaussian;  // of each pair, among the gaussians of all draws

    SelectionDraws(const py::list& bundles, const py::tuple& instances, const Camera& eye,
                   const py::array& instance_ids, const py::array& cluster_ids) {
        for (const py::handle& item : bundles) tables.push_back(clusters_of(item));
        const InstanceTable placed = instance_table(instances, tables.size());
        const Span<const int32_t> instance = span_of<const int32_t>(instance_ids, "instance_ids", {-1});
        const Span<const int32_t> clusters =
            span_of<const int32_t>(cluster_ids, "cluster_ids", {static_cast<py::ssize_t>(instance.size)});
        int32_t last_instance = -1;
        uint64_t num_gaussians = 0;
        ModelView<float> view{};
        for (size_t s = 0; s < instance.size; ++s) {
            const int32_t i = instance[s], c = clusters[s];
            if (i < 0 || static_cast<size_t>(i) >= placed.bundle.size)
                throw py::value_error("instance_ids: expected ids of the scene's instances, got " +
                                      std::to_string(i));
            const BundleClusters& b = tables[placed.bundle[i]];
            if (c < 0 || static_cast<size_t>(c) >= b.filter_px2.size)
                throw py::value_error("cluster_ids: expected ids of the bundle's clusters, got " +
                                      std::to_string(c));
            const uint64_t first = b.offset[c], last = b.offset[c + 1];
            if (last < first || last > b.model->size())
                throw py::value_error("offset: expected ranges of the bundle's gaussians");
            last_gaussian.push_back(num_gaussians);
            if (i != last_instance) {
                const Pose pose = placed.pose(i);
                if (!is_placed(pose)) continue;
                view = model_view_from_instance(axes_of_instance(eye, pose), pose);
            }
            last_gaussian.back() = num_gaussians += last - first;
            const float filter = b.filter_px2[c];
            const bool compensate = b.compensate[c] != 0;
            if (i == last_instance) {
                Draw<float>& d = draws.back();
                if (d.first + d.count == first && d.filter_px2 == filter && d.compensate == compensate) {
                    d.count += last - first;
                    continue;
                }
            }
            draws.push_back({&b.model->planes(), first, last - first, view, filter, compensate});
            last_instance = i;
        }
    }
};

// Asks, from any thread, for work under way to end early.
class Stop {
  public:
    void request() { requested_.store(true, std::memory_order_relaxed); }
    bool is_requested() const { return requested_.load(std::memory_order_relaxed); }
    const std::atomic<bool>* flag() const { return &requested_; }

  private:
    std::atomic<bool> requested_{false};
};

static const std::atomic<bool>* flag_of(const Stop* stop) { return stop == nullptr ? nullptr : stop->flag(); }

static Window window_of(const Camera& c) {
    return {static_cast<int>(c.x0), static_cast<int>(c.y0), static_cast<int>(c.x1), static_cast<int>(c.y1)};
}

static SharedWorkspace& shared_workspace() {
    static SharedWorkspace shared;
    return shared;
}

// Draws with the shared workspace, without Python's lock.
static RenderCounts render_shared(const SelectionDraws& selected, const Camera& eye,
                                  const Picture<float>& picture, const Stop* stop) {
    const Pinhole<float> pinhole = pinhole_of(eye);
    py::gil_scoped_release unlocked;
    std::unique_ptr<Workspace<float>> workspace = shared_workspace().take();
    const RenderCounts counts =
        render<float>(selected.draws, pinhole, picture, false, *workspace, flag_of(stop));
    shared_workspace().give_back(std::move(workspace));
    return counts;
}

static py::tuple render_selection(const py::list& bundles, const py::tuple& instances,
                                  const py::tuple& camera, const py::array& instance_ids,
                                  const py::array& cluster_ids, const std::array<double, 3>& background,
                                  bool with_depth, const Stop* stop) {
    const Camera eye = select_camera(camera);
    const SelectionDraws selected(bundles, instances, eye, instance_ids, cluster_ids);
    PictureArrays<float> out(window_of(eye), background, with_depth);
    const RenderCounts counts = render_shared(selected, eye, out.picture, stop);
    return py::make_tuple(out.color, out.alpha, out.depth_or_none(), dict_of(counts));
}

// The number of gaussians that each pixel is blended of, and the counts of the frame.
static py::tuple count_selection(const py::list& bundles, const py::tuple& instances, const py::tuple& camera,
                                 const py::array& instance_ids, const py::array& cluster_ids,
                                 const Stop* stop) {
    const Camera eye = select_camera(camera);
    const SelectionDraws selected(bundles, instances, eye, instance_ids, cluster_ids);
    PictureArrays<float> out(window_of(eye), {0, 0, 0}, true);
    std::swap(out.picture.depth, out.picture.count);
    const RenderCounts counts = render_shared(selected, eye, out.picture, stop);
    return py::make_tuple(out.depth, dict_of(counts));
}

// Of the first pixel of the camera's window: (place in the selection, weight, depth) of the gaussian that it
// shows most of, or None.
static py::object pick_selection(const py::list& bundles, const py::tuple& instances, const py::tuple& camera,
                                 const py::array& instance_ids, const py::array& cluster_ids) {
    const Camera eye = select_camera(camera);
    const SelectionDraws selected(bundles, instances, eye, instance_ids, cluster_ids);
    const Pinhole<float> pinhole = pinhole_of(eye);
    const Window window = window_of(eye);
    Pick picked{};
    bool shows_any;
    {
        py::gil_scoped_release unlocked;
        shows_any = pick(selected.draws, pinhole, window.x0, window.y0, picked);
    }
    if (!shows_any) return py::none();
    const auto pair =
        std::upper_bound(selected.last_gaussian.begin(), selected.last_gaussian.end(), picked.gaussian);
    return py::make_tuple(pair - selected.last_gaussian.begin(), picked.weight, picked.depth);
}

template <class T>
static void bind_precision(py::module_& m, const char* model_name, const char* tape_name) {
    py::class_<Model<T>, std::shared_ptr<Model<T>>>(m, model_name, "Gaussians laid out for the rasterizer.")
        .def(py::init(&make_model<T>), "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a)
        .def("__len__", &Model<T>::size);
    py::class_<Tape<T>, std::shared_ptr<Tape<T>>>(m, tape_name,
                                                  "What rasterize leaves for rasterize_backward.");
    m.def("rasterize", &rasterize<T>, "model"_a, "view"_a, "filter_px2"_a, "compensate"_a, "intrinsics"_a,
          "width"_a, "height"_a, "background"_a, "with_depth"_a, "keep_tape"_a);
    m.def("rasterize_backward", &rasterize_backward<T>, "tape"_a, "d_color"_a, "d_alpha"_a, "d_depth"_a);
}

void bind_render(py::module_& m) {
    bind_precision<float>(m, "Model", "Tape");
    bind_precision<double>(m, "ModelDouble", "TapeDouble");
    py::class_<Stop>(m, "Stop", "Asks, from any thread, for a picture under way to be given up.")
        .def(py::init<>())
        .def("request", &Stop::request)
        .def_property_readonly("is_requested", &Stop::is_requested);
    m.def("render_selection", &render_selection, "bundles"_a, "instances"_a, "camera"_a, "instance_ids"_a,
          "cluster_ids"_a, "background"_a, "with_depth"_a, "stop"_a = nullptr);
    m.def("count_selection", &count_selection, "bundles"_a, "instances"_a, "camera"_a, "instance_ids"_a,
          "cluster_ids"_a, "stop"_a = nullptr);
    m.def("pick_selection", &pick_selection, "bundles"_a, "instances"_a, "camera"_a, "instance_ids"_a,
          "cluster_ids"_a);
}

}  // namespace v3dg

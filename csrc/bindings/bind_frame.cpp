#include "bindings/args.h"

#if V3DG_WITH_CUDA

#include <memory>

#include "bindings/frame_args.h"
#include "bindings/select_args.h"

namespace v3dg {

namespace {

using namespace py::literals;

// A frame in flight and what it reads and writes.
class BoundDrawing {
  public:
    BoundDrawing(py::object frame, py::object arrays, std::unique_ptr<cuda::Drawing> drawing)
        : frame_(std::move(frame)), arrays_(std::move(arrays)), drawing_(std::move(drawing)) {}

    py::dict finish() {
        {
            const py::gil_scoped_release unlocked;
            drawing_->wait();
        }
        const cuda::FrameCounters& c = drawing_->finish();  // which may draw, and so keeps other threads out
        const cuda::FrameTimes times = drawing_->times();
        return py::dict("items"_a = c.items, "gaussians"_a = c.gaussians, "in_frustum"_a = c.in_frustum,
                        "records"_a = c.records, "entries"_a = c.entries,
                        "tolerance"_a = c.choice.tolerance_px2, "exceeds_budget"_a = c.choice.exceeds_budget,
                        "least"_a = c.choice.least, "select_ms"_a = times.prepare_ms,
                        "draw_ms"_a = times.draw_ms);
    }

  private:
    py::object frame_, arrays_;
    std::unique_ptr<cuda::Drawing> drawing_;  // gone before what it reads
};

// The tables and instances of a scene on a device.
class BoundScene {
  public:
    // A bundle is (table, filter_px2, antialiased).
    BoundScene(const py::list& bundles, uintptr_t stream) {
        std::vector<ClusterTable> tables;
        std::vector<cuda::ClusterFilters> filters;
        for (const py::handle& bundle : bundles) {
            const py::tuple t = bundle.cast<py::tuple>();
            const ClusterTable& table = t[0].cast<const BoundTable&>().table();
            const py::ssize_t clusters = static_cast<py::ssize_t>(table.own_group.size);
            tables.push_back(table);
            num_gaussians_.push_back(table.offset[clusters]);
            filters.push_back({span_of<const float>(t[1].cast<py::array>(), "filter_px2", {clusters}),
                               span_of<const uint8_t>(t[2].cast<py::array>(), "antialiased", {clusters})});
        }
        tables_ = std::make_unique<cuda::SceneTables>(
            Span<const ClusterTable>{tables.data(), tables.size()},
            Span<const cuda::ClusterFilters>{filters.data(), filters.size()}, stream_of(stream));
    }

    cuda::SceneTables& tables() { return *tables_; }
    const std::vector<int64_t>& num_gaussians() const { return num_gaussians_; }

    void set_instances(const py::array& bundle, const py::array& importance, uintptr_t stream) {
        const Span<const int32_t> bundles = bundle_of_instance(bundle, num_gaussians_.size());
        tables_->set_instances(
            bundles, span_of<const float>(importance, "importance", {static_cast<py::ssize_t>(bundles.size)}),
            stream_of(stream));
    }
    void set_poses(const py::object& positions, const py::object& quaternions, const py::object& scales,
                   uintptr_t stream) {
        const auto count = static_cast<py::ssize_t>(tables_->num_instances());
        tables_->set_poses(doubles_anywhere(positions, "positions", {count, 3}),
                           doubles_anywhere(quaternions, "quaternions", {count, 4}),
                           doubles_anywhere(scales, "scales", {count}), stream_of(stream));
    }

    py::tuple select(const py::tuple& camera, const py::tuple& rule, uintptr_t stream) {
        SelectOutput out;
        const Camera c = select_camera(camera);
        const SelectRule r = select_rule(rule);
        {
            const py::gil_scoped_release unlocked;
            tables_->select(c, r, out, stream_of(stream));
        }
        return tuple_of(out);
    }

  private:
    static cuda::PoseSpan doubles_anywhere(const py::handle& array, const char* name,
                                           std::initializer_list<py::ssize_t> shape) {
        if (py::hasattr(array, "__cuda_array_interface__"))
            return {device_span_of<const double>(array, name, shape), true};
        return {span_of<const double>(array.cast<py::array>(), name, shape), false};
    }

    std::vector<int64_t> num_gaussians_;  // of each bundle
    std::unique_ptr<cuda::SceneTables> tables_;
};

// Draws scenes of the same bundles.
class BoundSceneFrame {
  public:
    BoundSceneFrame(const py::list& rows_of_bundles, uintptr_t stream) : arrays_(rows_of_bundles) {
        std::vector<cuda::PackedModel> models;
        for (const py::handle& arrays : rows_of_bundles) {
            const GaussianRows<const float> rows = rows_of(arrays);
            models.emplace_back(rows, stream_of(stream));
            num_gaussians_.push_back(static_cast<int64_t>(rows.size));
        }
        frame_ = std::make_unique<cuda::SceneFrame>(std::move(models), stream_of(stream));
    }

    cuda::SceneFrame& frame_of(const BoundScene& scene) {
        if (scene.num_gaussians() != num_gaussians_)
            throw py::value_error("scene: expected one of the bundles that the frame has the gaussians of");
        return *frame_;
    }

  private:
    py::object arrays_;
    std::vector<int64_t> num_gaussians_;  // of each bundle
    std::unique_ptr<cuda::SceneFrame> frame_;
};

std::unique_ptr<BoundDrawing> draw_scene(const py::object& frame, const py::object& scene,
                                         const py::tuple& camera, const py::tuple& rule,
                                         const std::array<double, 3>& background, const py::tuple& picture,
                                         uintptr_t stream) {
    const Camera c = select_camera(camera);
    const cuda::FrameImage image = image_of(intrinsics_of(c), background, picture);
    BoundScene& bound = scene.cast<BoundScene&>();
    return std::make_unique<BoundDrawing>(
        frame, py::make_tuple(scene, picture),
        frame.cast<BoundSceneFrame&>().frame_of(bound).draw(bound.tables(), c, select_rule(rule), image,
                                                            stream_of(stream)));
}

std::unique_ptr<BoundDrawing> draw_cut(const py::object& frame, const py::object& scene,
                                       const py::tuple& camera, const py::object& instance_ids,
                                       const py::object& cluster_ids, const std::array<double, 3>& background,
                                       const py::tuple& picture, uintptr_t stream) {
    const Camera c = select_camera(camera);
    const cuda::FrameImage image = image_of(intrinsics_of(c), background, picture);
    BoundScene& bound = scene.cast<BoundScene&>();
    const Span<const int32_t> instances = device_span_of<const int32_t>(instance_ids, "instance_ids", {-1});
    const Span<const int32_t> clusters =
        device_span_of<const int32_t>(cluster_ids, "cluster_ids", {static_cast<py::ssize_t>(instances.size)});
    return std::make_unique<BoundDrawing>(
        frame, py::make_tuple(scene, picture, instance_ids, cluster_ids),
        frame.cast<BoundSceneFrame&>().frame_of(bound).draw_cut(bound.tables(), c, instances, clusters, image,
                                                                stream_of(stream)));
}

class BoundModel {
  public:
    BoundModel(const py::tuple& gaussians, uintptr_t stream)
        : BoundModel(gaussians, rows_of(gaussians), stream) {}

    std::unique_ptr<cuda::Drawing> draw(const ModelView<float>& view, double filter_px2, bool compensate,
                                        const cuda::FrameImage& image, uintptr_t stream) {
        return frame_.draw(model_.rows(), view, static_cast<float>(filter_px2), compensate, image,
                           stream_of(stream), &model_.packed());
    }

  private:
    BoundModel(const py::tuple& gaussians, const GaussianRows<const float>& rows, uintptr_t stream)
        : arrays_(gaussians), model_(rows, stream_of(stream)) {}

    py::object arrays_;
    cuda::PackedModel model_;
    cuda::ModelFrame frame_;
};

std::unique_ptr<BoundDrawing> draw_model(const py::object& frame, const std::array<double, 15>& view,
                                         double filter_px2, bool compensate, const std::array<double, 5>& k,
                                         const std::array<double, 3>& background, const py::tuple& picture,
                                         uintptr_t stream) {
    return std::make_unique<BoundDrawing>(
        frame, picture,
        frame.cast<BoundModel&>().draw(view_of<float>(view.data()), filter_px2, compensate,
                                       image_of(k, background, picture), stream));
}

}  // namespace

void bind_frame(py::module_& m) {
    py::class_<BoundDrawing>(m, "Drawing", "A frame that has been enqueued on a device.")
        .def("finish", &BoundDrawing::finish,
             "Waits for the picture; what was counted and how long it took.");
    py::class_<BoundScene>(m, "DeviceScene", "What selection reads of a scene, on a device.")
        .def(py::init<const py::list&, uintptr_t>(), "bundles"_a, "stream"_a)
        .def("set_instances", &BoundScene::set_instances, "bundle"_a, "importance"_a, "stream"_a)
        .def("set_poses", &BoundScene::set_poses, "positions"_a, "quaternions"_a, "scales"_a, "stream"_a)
        .def("select", &BoundScene::select, "camera"_a, "rule"_a, "stream"_a, "As select on the host does.");
    py::class_<BoundSceneFrame>(m, "SceneFrame", "Draws scenes of the same bundles.")
        .def(py::init<const py::list&, uintptr_t>(), "bundles"_a, "stream"_a)
        .def("draw", &draw_scene, "scene"_a, "camera"_a, "rule"_a, "background"_a, "picture"_a, "stream"_a)
        .def("draw_cut", &draw_cut, "scene"_a, "camera"_a, "instance_ids"_a, "cluster_ids"_a, "background"_a,
             "picture"_a, "stream"_a);
    py::class_<BoundModel>(m, "ModelFrame", "Draws gaussians that stay on a device.")
        .def(py::init<const py::tuple&, uintptr_t>(), "gaussians"_a, "stream"_a)
        .def("draw", &draw_model, "view"_a, "filter_px2"_a, "compensate"_a, "intrinsics"_a, "background"_a,
             "picture"_a, "stream"_a);
}

}  // namespace v3dg

#else

void v3dg::bind_frame(py::module_&) {}

#endif

#pragma once

// What stays on one device from frame to frame: gaussians, palettes and scenes.

#include <memory>
#include <vector>

#include "bindings/codes.h"
#include "bindings/tables.h"
#include "draw/model.h"
#include "draw/scene_frame.h"
#include "select/budget_steps.h"
#include "select/select.h"

#if V3DG_WITH_CUDA
#include "draw/scene_frame_cuda.h"
#endif

namespace v3dg {

// The gaussians of a bundle or an asset as frames of one device read them.
class BoundModel {
  public:
    explicit BoundModel(const Rows& rows) : device_(rows.device()), size_(rows.size()) {
        const GaussianRows<const float> read = rows.read<float>();
        const Work work(device_);
        if (device_.is_host()) {
            const Unlocked unlocked;
            host_ = std::make_shared<Model<float>>(read);
            return;
        }
#if V3DG_WITH_CUDA
        rows_ = std::make_unique<Rows>(rows);
        on_device_.packed = std::make_shared<cuda::PackedModel>(read, work.stream());
#endif
    }
    BoundModel(const py::object& codes, int device) : device_{device} {
        const auto& given = held<BoundCodes>(codes, "codes");
        size_ = given.num_gaussians();
        const Work work(device_);
        codes_ = given.pages().codes();
        for (size_t c = 0; c < codes_.num_clusters(); ++c)
            num_gaussians_.push_back(
                static_cast<uint32_t>(codes_.offset[c + 1] - codes_.offset[c]));
        if (device_.is_host()) {
            codes_object_ = codes;
            return;
        }
#if V3DG_WITH_CUDA
        const Unlocked unlocked;
        on_device_.coded = std::make_shared<cuda::CodedModel>(given.pages(), work.stream());
        codes_ = on_device_.coded->codes();
#endif
    }

    Device device() const { return device_; }
    size_t size() const { return size_; }
    bool has_codes() const { return codes_.offset.size > 0; }
    // On the host; without what the scene knows of the clusters.
    SceneModel on_host() const {
        return {has_codes() ? nullptr : &host_->planes(), {}, {}, has_codes() ? &codes_ : nullptr};
    }
    size_t bytes() const {
        if (host_ != nullptr) return host_->bytes();
        if (device_.is_host()) return codes_.range_size * codes_.num_clusters();
#if V3DG_WITH_CUDA
        if (has_codes()) return on_device_.coded->bytes();
        return on_device_.packed->bytes() +
               size_ * sizeof(float) * (11 + 3 * num_sh_bases(rows_->sh_degree()));
#else
        return 0;
#endif
    }
#if V3DG_WITH_CUDA
    const cuda::DeviceModel& on_device() const { return on_device_; }
#endif

    // The gaussians of clusters, from codes: means, quats, scales, opacities, sh.
    py::tuple decode(const py::array& cluster_ids) const {
        if (!has_codes())
            throw py::value_error("decode: expected a model of codes, got one of rows");
        const Span<const int32_t> cluster =
            span_of<const int32_t>(cluster_ids, "cluster_ids", {-1});
        std::vector<int64_t> offset{0};
        for (const int32_t c : cluster) {
            if (c < 0 || static_cast<size_t>(c) >= num_gaussians_.size())
                throw std::out_of_range("cluster_ids: expected ids below " +
                                        std::to_string(num_gaussians_.size()) + ", got " +
                                        std::to_string(c));
            offset.push_back(offset.back() + num_gaussians_[c]);
        }
        const Work work(device_);
        const NewRows out(device_, static_cast<size_t>(offset.back()), codes_.sh_degree);
        const DecodeInput in{codes_, cluster, {offset.data(), offset.size()}};
        {
            const Unlocked unlocked;
            V3DG_DISPATCH(work, decode, in, out.rows());
        }
        return out.arrays();
    }

  private:
    Device device_;
    size_t size_ = 0;
    std::shared_ptr<Model<float>> host_;
    py::object codes_object_;  // which `codes_` is of, on the host
    Codes codes_{};
    std::vector<uint32_t> num_gaussians_;  // of each cluster of codes
#if V3DG_WITH_CUDA
    std::unique_ptr<Rows> rows_;  // which the packed model reads
    cuda::DeviceModel on_device_;
#endif
};

// Colours of the clusters of one bundle on one device.
class BoundPalette {
  public:
    BoundPalette(const py::object& table_object, const py::array& sh, int device)
        : table_(table_object), sh_(sh), device_{device} {
        const auto& table = held<BoundTable>(table_object, "table");
        const auto clusters = static_cast<py::ssize_t>(table.table().num_clusters());
        const Span<const float> colors = span_of<const float>(sh, "sh", {clusters, 3});
        host_ = {colors.data, table.table().offset.data, static_cast<uint32_t>(clusters)};
        const Work work(device_);
#if V3DG_WITH_CUDA
        if (device_.is_host()) return;
        on_device_ =
            std::make_shared<cuda::DevicePalette>(colors, table.on_device(work), work.stream());
#endif
    }

    Device device() const { return device_; }
    const Palette& host() const { return host_; }
#if V3DG_WITH_CUDA
    const std::shared_ptr<const cuda::DevicePalette>& on_device() const { return on_device_; }
#endif

  private:
    py::object table_;
    py::array sh_;
    Device device_;
    Palette host_;
#if V3DG_WITH_CUDA
    std::shared_ptr<const cuda::DevicePalette> on_device_;
#endif
};

// A scene as the host knows it. It stays as it is: whoever draws it keeps it, and a change makes
// another.
struct SceneState {
    py::list bundles;
    py::tuple arrays;
    std::vector<ClusterTable> tables;
    std::vector<size_t> num_gaussians;  // of each bundle
    InstanceTable instances;

    const BoundTable& bundle(size_t b) const { return held<BoundTable>(bundles[b], "tables"); }
};

// What selection reads of a scene, on one device.
class BoundScene {
  public:
    explicit BoundScene(int device) : device_{device}, state_(std::make_shared<SceneState>()) {
        const Work work(device_);
#if V3DG_WITH_CUDA
        if (!device_.is_host()) {
            on_device_ = std::make_unique<cuda::SceneTables>();
            cut_ = std::make_unique<cuda::Cut>();
        }
#endif
        set_bundles(py::list());
    }

    Device device() const { return device_; }
    std::shared_ptr<const SceneState> state() const { return state_; }
#if V3DG_WITH_CUDA
    const cuda::SceneTables& on_device() const { return *on_device_; }
#endif

    // Takes the place of all bundles; instances come next.
    void set_bundles(const py::list& bundles) {
        auto state = std::make_shared<SceneState>();
        state->bundles = bundles;
        for (const py::handle& bundle : bundles) {
            const auto& table = held<BoundTable>(bundle, "tables");
            state->tables.push_back(table.table());
            state->num_gaussians.push_back(table.num_gaussians());
        }
#if V3DG_WITH_CUDA
        if (!device_.is_host()) {
            const Work work(device_);
            std::vector<std::shared_ptr<const cuda::BundleTables>> tables;
            for (size_t b = 0; b < state->tables.size(); ++b)
                tables.push_back(state->bundle(b).on_device(work));
            on_device_->set_bundles(std::move(tables), work.stream());
        }
#endif
        state_ = std::move(state);
    }

    void set_instances(const py::array& bundle, const py::array& importance,
                       const py::object& positions, const py::object& quaternions,
                       const py::object& scales) {
        auto state = std::make_shared<SceneState>(*state_);
        InstanceTable& instances = state->instances;
        instances.bundle = span_of<const int32_t>(bundle, "bundle", {-1});
        check_instance_bundles(instances.bundle, state->tables.size());
        const auto count = static_cast<py::ssize_t>(instances.bundle.size);
        instances.importance = span_of<const float>(importance, "importance", {count});
        state->arrays = py::make_tuple(bundle, importance, positions, quaternions, scales);
        if (device_.is_host()) {
            instances.position = span_of<const double>(positions, "positions", {count, 3});
            instances.quaternion = span_of<const double>(quaternions, "quaternions", {count, 4});
            instances.scale = span_of<const double>(scales, "scales", {count});
        }
#if V3DG_WITH_CUDA
        if (!device_.is_host()) {
            const Work work(device_);
            on_device_->set_instances(instances.bundle, instances.importance, work.stream());
        }
#endif
        state_ = std::move(state);
        if (!device_.is_host()) set_poses(positions, quaternions, scales);
    }

    // New poses of the same instances.
    void set_poses(const py::object& positions, const py::object& quaternions,
                   const py::object& scales) {
        if (device_.is_host()) {
            const py::tuple arrays = state_->arrays;
            set_instances(arrays[0], arrays[1], positions, quaternions, scales);
            return;
        }
#if V3DG_WITH_CUDA
        auto state = std::make_shared<SceneState>(*state_);
        const auto count = static_cast<py::ssize_t>(state->instances.bundle.size);
        state->arrays =
            py::make_tuple(state->arrays[0], state->arrays[1], positions, quaternions, scales);
        const Work work(device_);
        on_device_->set_poses(doubles_anywhere(positions, "positions", {count, 3}),
                              doubles_anywhere(quaternions, "quaternions", {count, 4}),
                              doubles_anywhere(scales, "scales", {count}), work.stream());
        state_ = std::move(state);
#endif
    }

    // With `steps`, for pictures that follow each other, which it is of.
    BoundCut select(const BoundEyes& camera, const SelectRule& rule, BudgetSteps* steps) {
        if (camera.eyes.are_two && rule.footprint == Footprint::paper)
            throw py::value_error("footprint: expected 'solid_angle' for two eyes, got 'paper'");
        const std::shared_ptr<const SceneState> state = state_;
        const Work work(device_);
        const auto cut = [&](const SelectRule& paced, uint32_t* last_bin) {
            const Unlocked unlocked;
            SelectOutput out;
            if (device_.is_host())
                cpu::select({{state->tables.data(), state->tables.size()},
                             state->instances,
                             camera.eyes,
                             paced,
                             {},
                             last_bin},
                            out);
#if V3DG_WITH_CUDA
            else
                cut_->select(*on_device_, camera.eyes, paced, out, work.stream(), nullptr,
                             last_bin);
#endif
            return out;
        };
        return BoundCut(in_steps(steps, rule, camera.eyes, state, cut));
    }

    // Priorities of the pages of each bundle, on the host.
    py::list page_needs(const BoundCamera& camera, const SelectRule& rule) const {
        if (!device_.is_host())
            throw py::value_error(
                "page_needs: expected a scene on the CPU, got one on a CUDA device");
        const std::shared_ptr<const SceneState> state = state_;
        py::list priorities;
        std::vector<Span<uint32_t>> needs;
        for (const ClusterTable& table : state->tables) {
            const NewArray<float> priority({}, {static_cast<py::ssize_t>(table.num_pages())});
            std::fill(priority.span.begin(), priority.span.end(), 0.0f);
            needs.push_back({reinterpret_cast<uint32_t*>(priority.span.data), priority.span.size});
            priorities.append(priority.object);
        }
        SelectOutput out;
        const Unlocked unlocked;
        cpu::select({{state->tables.data(), state->tables.size()},
                     state->instances,
                     camera.camera,
                     rule,
                     {needs.data(), needs.size()}},
                    out);
        return priorities;
    }

  private:
#if V3DG_WITH_CUDA
    static cuda::PoseSpan doubles_anywhere(const py::handle& array, const char* name, Shape shape) {
        const bool is_host = device_of(array, name).is_host();
        return {is_host ? span_of<const double>(array, name, shape)
                        : device_span_of<const double>(array, name, shape),
                !is_host};
    }
    std::unique_ptr<cuda::SceneTables> on_device_;
    std::unique_ptr<cuda::Cut> cut_;
#endif

    Device device_;
    std::shared_ptr<const SceneState> state_;
};

}  // namespace v3dg

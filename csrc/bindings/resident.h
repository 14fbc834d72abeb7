#pragma once

// Objects that stay on one device between frames: models, palettes and scenes. Each has
// a handle from the device's backend.

#include <memory>
#include <vector>

#include "bindings/backend.h"
#include "bindings/tables.h"
#include "residency/environments.h"

namespace v3dg {

// The gaussians of a bundle or an asset, in the layout that frames on one device read.
class BoundModel {
  public:
    explicit BoundModel(const Rows& rows);
    BoundModel(const py::object& codes, int device);

    Device device() const { return device_; }
    size_t size() const { return size_; }
    bool has_codes() const { return is_coded_; }
    size_t bytes() const { return model_->bytes(); }
    const std::shared_ptr<const backend::Model>& handle() const { return model_; }

    // Returns the gaussians of some clusters of a coded model as arrays: means, quats,
    // scales, opacities, sh.
    py::tuple decode(const py::array& cluster_ids) const;

  private:
    Device device_;
    size_t size_ = 0;
    bool is_coded_ = false;
    int sh_degree_ = 0;
    std::vector<uint32_t> num_gaussians_;  // number of gaussians in each cluster of a
                                           // coded model
    std::shared_ptr<const backend::Model> model_;
};

// The colours of the clusters of one bundle, on one device.
class BoundPalette {
  public:
    BoundPalette(const py::object& table, const py::array& sh, int device);

    Device device() const { return device_; }
    const std::shared_ptr<const backend::Palette>& handle() const { return palette_; }

  private:
    Device device_;
    std::shared_ptr<const backend::Palette> palette_;
};

// A scene on the host. It is immutable: each change creates a new object, and a frame
// in progress keeps the old one.
struct SceneState {
    py::list bundles;
    // The arrays of the instances: bundle, importance, positions, quaternions, scales,
    // factors.
    py::tuple arrays;
    std::vector<ClusterTable> tables;
    std::vector<size_t> num_gaussians;  // number of gaussians of each bundle
    InstanceTable instances;            // only has poses if the host can read the arrays
    std::shared_ptr<const Environments> environments =
        std::make_shared<Environments>(Span<const int32_t>{});

    // The label of each instance, or null if no instance has one.
    std::shared_ptr<const std::vector<int32_t>> labels;

    Span<const int32_t> label_span() const {
        if (labels == nullptr) return {};
        return {labels->data(), labels->size()};
    }
    const BoundTable& bundle(size_t b) const { return held<BoundTable>(bundles[b], "tables"); }
};

// The part of a scene that selection reads, on one device.
class BoundScene {
  public:
    explicit BoundScene(int device);

    Device device() const { return device_; }
    std::shared_ptr<const SceneState> state() const { return state_; }
    const backend::Scene& handle() const { return *scene_; }

    // Replaces all bundles. The caller must then set the instances.
    void set_bundles(const py::list& bundles);
    void set_instances(const py::array& bundle, const py::array& importance,
                       const py::object& positions, const py::object& quaternions,
                       const py::object& scales, const py::object& factors,
                       const py::object& environments, const py::object& labels);
    // Sets new poses of the same instances.
    void set_poses(const py::object& positions, const py::object& quaternions,
                   const py::object& scales);

    // `steps` is the state of a sequence of cuts, or null for a single cut.
    BoundCut select(const BoundEyes& camera, const SelectRule& rule, BudgetSteps* steps);
    // Returns the priority of each page, (pages,) float32 for each bundle. It is 0 if
    // the cut does not need the page. The scene must be on the host.
    py::list page_needs(const BoundCamera& camera, const SelectRule& rule) const;

  private:
    Device device_;
    std::shared_ptr<const SceneState> state_;
    std::unique_ptr<backend::Scene> scene_;
};

}  // namespace v3dg

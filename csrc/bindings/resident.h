#pragma once

// What stays on one device from frame to frame: gaussians, palettes and scenes. Each has a handle
// that its device's backend made.

#include <memory>
#include <vector>

#include "bindings/backend.h"
#include "bindings/tables.h"

namespace v3dg {

// The gaussians of a bundle or an asset as frames of one device read them.
class BoundModel {
  public:
    explicit BoundModel(const Rows& rows);
    BoundModel(const py::object& codes, int device);

    Device device() const { return device_; }
    size_t size() const { return size_; }
    bool has_codes() const { return is_coded_; }
    size_t bytes() const { return model_->bytes(); }
    const std::shared_ptr<const backend::Model>& handle() const { return model_; }

    // The gaussians of clusters, from codes: means, quats, scales, opacities, sh.
    py::tuple decode(const py::array& cluster_ids) const;

  private:
    Device device_;
    size_t size_ = 0;
    bool is_coded_ = false;
    int sh_degree_ = 0;
    std::vector<uint32_t> num_gaussians_;  // of each cluster of codes
    std::shared_ptr<const backend::Model> model_;
};

// Colours of the clusters of one bundle on one device.
class BoundPalette {
  public:
    BoundPalette(const py::object& table, const py::array& sh, int device);

    Device device() const { return device_; }
    const std::shared_ptr<const backend::Palette>& handle() const { return palette_; }

  private:
    Device device_;
    std::shared_ptr<const backend::Palette> palette_;
};

// A scene as the host knows it. It stays as it is: whoever draws it keeps it, and a change makes
// another.
struct SceneState {
    py::list bundles;
    // Bundle, importance, positions, quaternions, scales and factors of the instances.
    py::tuple arrays;
    std::vector<ClusterTable> tables;
    std::vector<size_t> num_gaussians;  // of each bundle
    InstanceTable instances;            // poses only where the host reads the arrays

    const BoundTable& bundle(size_t b) const { return held<BoundTable>(bundles[b], "tables"); }
};

// What selection reads of a scene, on one device.
class BoundScene {
  public:
    explicit BoundScene(int device);

    Device device() const { return device_; }
    std::shared_ptr<const SceneState> state() const { return state_; }
    const backend::Scene& handle() const { return *scene_; }

    // Takes the place of all bundles; instances come next.
    void set_bundles(const py::list& bundles);
    void set_instances(const py::array& bundle, const py::array& importance,
                       const py::object& positions, const py::object& quaternions,
                       const py::object& scales, const py::object& factors);
    // New poses of the same instances.
    void set_poses(const py::object& positions, const py::object& quaternions,
                   const py::object& scales);

    // With `steps`, the cut of one of several pictures that follow each other.
    BoundCut select(const BoundEyes& camera, const SelectRule& rule, BudgetSteps* steps);
    // Priorities of the pages of each bundle, on the host.
    py::list page_needs(const BoundCamera& camera, const SelectRule& rule) const;

  private:
    Device device_;
    std::shared_ptr<const SceneState> state_;
    std::unique_ptr<backend::Scene> scene_;
};

}  // namespace v3dg

#pragma once

// A page pool on one device: the resident part of bundles, in memory of a fixed size.

#include <memory>
#include <vector>

#include "bindings/resident.h"

namespace v3dg {

class BoundPool {
  public:
    // `sources` has one element per table: either the gaussians in memory (Rows), or
    // the file of the bundle (FileSource).
    BoundPool(const py::list& tables, const py::list& sources, int device, size_t num_bytes,
              unsigned num_threads);
    ~BoundPool();

    Device device() const { return device_; }
    PagePool& pool() { return *pool_; }
    PoolStatus status() const { return pool_->status(); }
    backend::Pool& handle() { return *on_device_; }
    void check_scene(const SceneState& scene) const;

    // Makes one step towards a state in which all pages of a view are resident
    // (backend::Pool::settle_step()).
    SettlingStep settle_step(const py::object& scene_object, const BoundEyes& camera,
                             const SelectRule& rule, bool begins);

  private:
    const Device device_;
    const py::list tables_, sources_;
    std::unique_ptr<PagePool> pool_;
    std::unique_ptr<backend::Pool> on_device_;
};

}  // namespace v3dg

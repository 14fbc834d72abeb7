#pragma once

// The part of bundles that is resident, of a size that does not grow.

#include <algorithm>
#include <memory>
#include <vector>

#include "base/mutex.h"
#include "bindings/resident.h"
#include "residency/host_pages.h"

#if V3DG_WITH_CUDA
#include "draw/device_pages.h"
#endif

namespace v3dg {

// Frames of a pool: one of a flight; a look at what a view needs, the first or a later one while it
// settles; and one aside, for which pages neither come nor are asked for: of what was there for the
// last one, as that was.
enum class PoolFrame { flight, first_look, look, aside };

class BoundPool {
  public:
    // `sources` has for each table either the arrays of gaussians in memory, or the file of the
    // bundle: its name, descriptor, codec, SH degree, places (P+1,), hashes (P, 16), and what
    // fetches parts of it, or None.
    BoundPool(const py::list& tables, const py::list& sources, int device, size_t num_bytes,
              unsigned num_threads);
    ~BoundPool();

    Device device() const { return device_; }
    PagePool& pool() { return *pool_; }
    PoolStatus status() const { return pool_->status(); }
    void check_scene(const SceneState& scene) const;

    // A frame on the host: brings pages, calls cut(tables, rule, needs), which returns the
    // tolerance that was used, and takes note of what that needed. Without Python's lock.
    template <class Cut>
    NotedView frame_on_host(const SceneState& scene, SelectRule rule, PoolFrame kind,
                            const Cut& cut) {
        pool_->check_process();  // In a child of fork() the lock may be held for ever.
        const MutexLock lock(busy_);
        if (kind == PoolFrame::first_look) pool_->begin_settling();
        const bool is_aside = kind == PoolFrame::aside && has_begun_;
        const bool is_bounded = kind == PoolFrame::flight || kind == PoolFrame::aside;
        if (!is_aside) {
            const Arrive arrive = rule.fade.is_on() ? Arrive::fading : Arrive::at_once;
            host_->apply(*pool_, pool_->begin_frame(is_bounded, arrive));
            pool_->release();
            has_begun_ = true;
        }
        std::vector<ClusterTable> tables = scene.tables;
        std::vector<Span<uint32_t>> needs;
        for (size_t b = 0; b < tables.size(); ++b) {
            tables[b].pages.shift = pool_->shift(b);
            tables[b].pages.begins = pool_->begins(b);
            if (is_aside) continue;
            needs_[b].assign(tables[b].num_pages(), 0);
            needs.push_back({needs_[b].data(), needs_[b].size()});
        }
        rule.tolerance_px2 = std::max(rule.tolerance_px2, pool_->least_tolerance_px2());
        rule.frame = pool_->arrivals().frame();
        const float used = cut(Span<const ClusterTable>{tables.data(), tables.size()}, rule,
                               Span<const Span<uint32_t>>{needs.data(), needs.size()});
        return is_aside ? NotedView{} : note_needs(used, is_bounded);
    }
    const HostPages& on_host() const { return *host_; }
#if V3DG_WITH_CUDA
    cuda::DevicePages& on_device() { return *on_device_; }
#endif

    // Takes a step towards settling a view: brings all pages that were read, cuts the scene without
    // drawing it, and waits until the pool has decided about what the cut needs. `begins`: the
    // first step, which forgets earlier frames (PagePool::begin_settling).
    SettlingStep settle_step(const py::object& scene_object, const BoundEyes& camera,
                             const SelectRule& rule, bool begins);

  private:
#if V3DG_WITH_CUDA
    void make_on_device(const Work& work);
#endif
    NotedView note_needs(float tolerance_px2, bool is_bounded) V3DG_REQUIRES(busy_);

    const Device device_;
    const py::list tables_, sources_;
    std::unique_ptr<PagePool> pool_;
    std::unique_ptr<HostPages> host_;
#if V3DG_WITH_CUDA
    std::unique_ptr<cuda::DevicePages> on_device_;
#endif
    Mutex busy_;
    bool has_begun_ V3DG_GUARDED_BY(busy_) = false;                    // with a frame on the host
    std::vector<std::vector<uint32_t>> needs_ V3DG_GUARDED_BY(busy_);  // of each bundle
};

}  // namespace v3dg

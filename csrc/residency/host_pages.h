#pragma once

// The slots of a page pool on the host.

#include <memory>
#include <vector>

#include "base/buffer.h"
#include "residency/page_pool.h"

namespace v3dg {

// Gaussians in slots, as planes that the bundles of the pool share.
class HostPages {
  public:
    HostPages(const PagePool& pool, size_t num_rows);

    // Brings pages to their slots.
    void apply(const PagePool& pool, const std::vector<PageChange>& changes);
    const GaussianPlanes<float>& planes(size_t bundle) const { return planes_[bundle]; }

  private:
    Buffer<float> storage_;
    size_t stride_;                              // of a plane
    std::vector<GaussianPlanes<float>> planes_;  // of each bundle, which differ in the degree
};

// Blocks on the host.
class HostBlocks : public BlockMemory {
  public:
    unsigned char* allocate(size_t bytes) override { return blocks_.emplace_back(bytes).data(); }

  private:
    std::vector<Buffer<unsigned char>> blocks_;
};

}  // namespace v3dg

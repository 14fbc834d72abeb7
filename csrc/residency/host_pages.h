#pragma once

// The slots of a page pool on the host. They hold either codes, or rows in planes that
// all bundles of the pool share.

#include <memory>
#include <vector>

#include "base/buffer.h"
#include "quantize/quantize.h"
#include "residency/page_pool.h"

namespace v3dg {

class HostPages {
  public:
    explicit HostPages(const PagePool& pool);

    // Copies arriving pages to their slots.
    void apply(const PagePool& pool, const std::vector<PageChange>& changes);
    // Return the gaussians of a bundle. One of planes() and codes() is null, depending
    // on PagePool::keeps_codes().
    const GaussianPlanes<float>* planes(size_t bundle) const {
        return planes_.empty() ? nullptr : &planes_[bundle];
    }
    const Codes* codes(size_t bundle) const { return codes_.empty() ? nullptr : &codes_[bundle]; }

  private:
    void make_planes(const PagePool& pool);
    void make_codes(const PagePool& pool);
    void write_rows(const PageSource& source, const PageChange& change);

    Buffer<float> storage_;
    size_t stride_ = 0;  // length of a plane
    // One element per bundle, because SH degrees may differ.
    std::vector<GaussianPlanes<float>> planes_;

    Buffer<uint32_t> records_, sh_;
    Buffer<unsigned char> ranges_;
    std::vector<int64_t> offset_;
    CodeSlots slots_{};
    std::vector<Codes> codes_;  // one element per bundle, because SH degrees may differ
};

// Memory for the blocks of a pool on the host.
class HostBlocks : public BlockMemory {
  public:
    unsigned char* allocate(size_t bytes) override { return blocks_.emplace_back(bytes).data(); }

  private:
    std::vector<Buffer<unsigned char>> blocks_;
};

}  // namespace v3dg

#pragma once

// Blocks of host memory. A block holds a page from the time it is read until it is
// copied to its slot. To waste little memory, blocks have a few different sizes.

#include <algorithm>
#include <cstddef>
#include <vector>

namespace v3dg {

// Allocates memory for blocks. The kind of memory depends on the device.
struct BlockMemory {
    virtual ~BlockMemory() = default;
    // The memory is freed when this object is destroyed.
    virtual unsigned char* allocate(size_t bytes) = 0;
};

class PageBlocks {
  public:
    // Allocates blocks of about `num_bytes` in total, but at most `most_blocks` blocks.
    // Their sizes are distributed like the page sizes in `samples`. Four more blocks
    // are allocated for the largest page.
    void allocate(const std::vector<size_t>& samples, size_t most_page_bytes, size_t num_bytes,
                  size_t most_blocks, BlockMemory& memory) {
        constexpr size_t kNumSizes = 8, kLeast = 64;
        const size_t step =
            (most_page_bytes + kNumSizes * kLeast - 1) / (kNumSizes * kLeast) * kLeast;
        std::vector<size_t> count(kNumSizes);
        size_t sum = 0;
        for (const size_t size : samples) {
            const size_t k = std::min((std::max<size_t>(size, 1) - 1) / step, kNumSizes - 1);
            ++count[k];
            sum += (k + 1) * step;
        }
        const size_t mean = samples.empty() ? step : sum / samples.size();
        const size_t wanted = std::min(num_bytes / mean, most_blocks);
        for (size_t k = 0; k < kNumSizes; ++k) {
            const size_t share = samples.empty() ? 0 : count[k] * wanted / samples.size();
            const size_t least =
                k + 1 == kNumSizes ? std::min<size_t>(4, std::max<size_t>(most_blocks, 1)) : 0;
            sizes_.push_back({.size = (k + 1) * step,
                              .first = nullptr,
                              .count = std::max(share, least),
                              .free = {}});
            num_bytes_ += sizes_.back().size * sizes_.back().count;
            num_blocks_ += sizes_.back().count;
        }
        unsigned char* block = memory.allocate(num_bytes_);
        for (Size& size : sizes_) {
            size.first = block;
            size.free.reserve(size.count);
            for (size_t i = 0; i < size.count; ++i, block += size.size) size.free.push_back(block);
        }
    }

    size_t num_blocks() const { return num_blocks_; }
    size_t num_bytes() const { return num_bytes_; }

    // Returns a block of at least `bytes` bytes, or null if none is free.
    unsigned char* take(size_t bytes) {
        for (Size& size : sizes_) {
            if (size.size < bytes || size.free.empty()) continue;
            unsigned char* block = size.free.back();
            size.free.pop_back();
            return block;
        }
        return nullptr;
    }
    void give_back(unsigned char* block) {
        size_t k = sizes_.size() - 1;
        while (k > 0 && (sizes_[k].count == 0 || block < sizes_[k].first)) --k;
        sizes_[k].free.push_back(block);
    }

  private:
    struct Size {
        size_t size;  // bytes per block
        unsigned char* first;
        size_t count;
        std::vector<unsigned char*> free;
    };
    std::vector<Size> sizes_;  // ascending
    size_t num_blocks_ = 0, num_bytes_ = 0;
};

}  // namespace v3dg

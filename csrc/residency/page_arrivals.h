#pragma once

// Tracks which pages of a pool have begun to fade in, and when.

#include <cstdint>
#include <vector>

#include "residency/page_policy.h"

namespace v3dg {

// Whether pages that become resident are drawn at full weight at once, or fade in.
enum class Arrive { at_once, fading };

// A page, by its index among the pages of all bundles, and the frame after which it
// begins to fade in.
struct Arrival {
    uint32_t page;
    int32_t begins;
};

// Decides when pages begin to fade in. A page waits until the page above it has faded
// in, so in every frame a page has faded in at most as far as the page above it. The
// state depends only on the changes of each frame.
class PageArrivals {
  public:
    // The coarsest pages count as faded in from the start.
    explicit PageArrivals(const PagePolicy& policy);

    // Begins the next frame. `changes` are the page changes before it. With
    // Arrive::at_once all pages count as faded in.
    void advance(const std::vector<PageChange>& changes, Arrive arrive);
    int32_t frame() const { return frame_; }
    // Returns the pages whose state changed with the last frame, each once.
    const std::vector<Arrival>& changed() const { return changed_; }
    // Returns the frame after which each page begins to fade in, as PageTable::begins:
    // [P] for the pages of all bundles.
    const std::vector<int32_t>& begins() const { return begins_; }

  private:
    struct Waiting {
        uint32_t page, above;
    };
    const PagePolicy& policy_;
    std::vector<int32_t> begins_;
    std::vector<Waiting> waiting_;  // in the order in which they became resident
    std::vector<Arrival> changed_;
    int32_t frame_ = 0, last_begin_ = 0;
};

}  // namespace v3dg

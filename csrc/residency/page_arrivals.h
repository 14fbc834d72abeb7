#pragma once

// Records when the pages of a pool begin to fade in.

#include <cstdint>
#include <vector>

#include "residency/page_policy.h"

namespace v3dg {

// How arriving pages are drawn: with full weight at once, or fading in.
enum class Arrive { at_once, fading };

// The frame after which a page begins to fade in. `page` is its index among the pages
// of all bundles.
struct Arrival {
    uint32_t page;
    int32_t begins;
};

// Decides when pages begin to fade in. A page begins when the page above it has faded
// in completely. So in every frame, a page has faded in at most as far as the page
// above it. The result depends only on the page changes of each frame.
class PageArrivals {
  public:
    // The coarsest pages are faded in from the start.
    explicit PageArrivals(const PagePolicy& policy);

    // Begins the next frame. `changes` are the page changes before this frame. With
    // Arrive::at_once, all pages have full weight immediately.
    void advance(const std::vector<PageChange>& changes, Arrive arrive);
    int32_t frame() const { return frame_; }
    // Returns the pages for which advance() changed the frame in its last call. Each
    // page occurs once.
    const std::vector<Arrival>& changed() const { return changed_; }
    // Returns, for the pages of all bundles, the frames after which they begin to fade
    // in: [P], as in PageTable::begins.
    const std::vector<int32_t>& begins() const { return begins_; }

  private:
    struct Waiting {
        uint32_t page, above;
    };
    const PagePolicy& policy_;
    std::vector<int32_t> begins_;
    std::vector<Waiting> waiting_;  // in the order of arrival
    std::vector<Arrival> changed_;
    int32_t frame_ = 0, last_begin_ = 0;
};

}  // namespace v3dg

#pragma once

// Which pages of a pool have begun to fade in, and when.

#include <cstdint>
#include <vector>

#include "residency/page_policy.h"

namespace v3dg {

// How what comes into a pool comes into pictures.
enum class Arrive { at_once, fading };

// A page, counted through those of all bundles, and the frame after which it begins to fade in.
struct Arrival {
    uint32_t page;
    int32_t begins;
};

// A page waits until the one above it has faded in, so that none is ever farther than those above
// it, in whichever frame one asks. The state follows from the changes of each frame alone.
class PageArrivals {
  public:
    // The coarsest pages are there from the start.
    explicit PageArrivals(const PagePolicy& policy);

    // Begins the next frame, with these changes before it. At once: everything has faded in.
    void advance(const std::vector<PageChange>& changes, Arrive arrive);
    int32_t frame() const { return frame_; }
    // Of the last frame: what became of pages, each once.
    const std::vector<Arrival>& changed() const { return changed_; }
    // [P] of all bundles' pages, as PageTable has them.
    const std::vector<int32_t>& begins() const { return begins_; }

  private:
    struct Waiting {
        uint32_t page, above;
    };
    const PagePolicy& policy_;
    std::vector<int32_t> begins_;
    std::vector<Waiting> waiting_;  // those that came later after those that came before
    std::vector<Arrival> changed_;
    int32_t frame_ = 0, last_begin_ = 0;
};

}  // namespace v3dg

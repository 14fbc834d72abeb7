#pragma once

// The largest number of cameras that a renderer draws together.

#include <algorithm>
#include <cstdint>

namespace v3dg {

// Halves the parts of batches that do not fit into the memory, and doubles them again
// after some batches that fit. A trial that fails costs a drawing, so it doubles the
// number of batches before the next trial.
class PartLimit {
  public:
    uint32_t most_cameras() const { return most_cameras_; }

    // Begins a batch that would have parts of `num_cameras` without a limit.
    void begin_batch(uint32_t num_cameras) {
        if (num_cameras <= most_cameras_) return;
        if (num_batches_++ < patience_) return;
        num_batches_ = 0;
        has_grown_ = true;
        most_cameras_ *= 2;
    }

    // Halves the parts, after one of `num_cameras` did not fit.
    void halve(uint32_t num_cameras) {
        most_cameras_ = std::min(most_cameras_, std::max(num_cameras / 2, 1u));
        if (has_grown_) patience_ = std::min(2 * patience_, kMostPatience);
        has_grown_ = false;
        num_batches_ = 0;
    }

  private:
    static constexpr uint32_t kMostPatience = 256;

    uint32_t most_cameras_ = ~0u;
    uint32_t num_batches_ = 0;  // batches since the limit last changed
    uint32_t patience_ = 1;     // batches before the next trial
    bool has_grown_ = false;    // since the last part that did not fit
};

}  // namespace v3dg

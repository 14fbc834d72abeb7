#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "base/span.h"

namespace v3dg {

constexpr size_t kPageHashBytes = 16, kHashBlockBytes = 128;
using PageHash = std::array<uint8_t, kPageHashBytes>;

// BLAKE2b with a digest of 16 bytes and no key, RFC 7693, of several messages: each in a lane of a vector
// where the processor has wide ones, so that eight of about the same length are quickest.
void blake2b(Span<const Span<const uint8_t>> messages, PageHash* digests);

// The same of bytes that come one after another.
class Blake2b {
  public:
    Blake2b();
    void add(const unsigned char* bytes, size_t size);
    // Of all that was added; nothing is added after it.
    PageHash digest();

  private:
    uint64_t state_[8];
    uint64_t num_bytes_ = 0;  // before those that wait
    unsigned char waiting_[kHashBlockBytes] = {};
    size_t num_waiting_ = 0;
};

}  // namespace v3dg

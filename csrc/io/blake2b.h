#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr size_t kPageHashBytes = 16, kHashBlockBytes = 128, kHashPieceBytes = 16384;
using PageHash = std::array<uint8_t, kPageHashBytes>;

// BLAKE2b with a digest of 16 bytes and no key, RFC 7693, of several messages: each in a lane of a
// vector where the processor has wide ones, so that eight of about the same length are quickest.
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

// The same of the digests of a message's pieces of kHashPieceBytes, the last of which may be
// shorter. They are hashed side by side, so it is several times as quick.
class HashOfPieces {
  public:
    explicit HashOfPieces(Span<const uint8_t> message) : message_(message) {}
    // So many bytes of the message are there.
    void add_until(size_t end);
    PageHash digest();

  private:
    const Span<const uint8_t> message_;
    std::vector<PageHash> digests_;
};

}  // namespace v3dg

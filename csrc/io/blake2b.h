#pragma once

// The hash of pages, tables and files: BLAKE2b for one message, for several at once,
// and for the pieces of a message.

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr size_t kPageHashBytes = 16;
constexpr size_t kHashBlockBytes = 128;
constexpr size_t kHashPieceBytes = 16384;
using PageHash = std::array<uint8_t, kPageHashBytes>;

// Computes the hashes of several messages: BLAKE2b (RFC 7693) with digests of 16 bytes
// and no key. On processors with wide vectors, each message is in one lane of a vector.
// Eight messages of similar length are hashed most efficiently.
void blake2b(Span<const Span<const uint8_t>> messages, PageHash* digests);

// Computes the hash of one message, which is added in parts.
class Blake2b {
  public:
    Blake2b();
    void add(const unsigned char* bytes, size_t size);
    // Returns the hash of all bytes that were added. After this call, no more bytes may
    // be added.
    PageHash digest();

  private:
    uint64_t state_[8];
    uint64_t num_bytes_ = 0;  // number of hashed bytes, without those in the buffer
    unsigned char waiting_[kHashBlockBytes] = {};
    size_t num_waiting_ = 0;
};

// Computes the hash of the digests of a message's pieces. A piece has kHashPieceBytes;
// the last one may be shorter. This is several times as fast as Blake2b, because pieces
// are hashed in parallel lanes.
class HashOfPieces {
  public:
    explicit HashOfPieces(Span<const uint8_t> message) : message_(message) {}
    // Hashes the pieces that are complete within the first `end` bytes of the message.
    void add_until(size_t end);
    PageHash digest();

  private:
    const Span<const uint8_t> message_;
    std::vector<PageHash> digests_;
};

}  // namespace v3dg

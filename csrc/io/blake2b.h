#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace v3dg {

constexpr size_t kPageHashBytes = 16;

// BLAKE2b with a digest of 16 bytes and no key; RFC 7693.
std::array<uint8_t, kPageHashBytes> blake2b(const unsigned char* bytes, size_t size);

// The same of bytes that come one after another.
class Blake2b {
  public:
    Blake2b();
    void add(const unsigned char* bytes, size_t size);
    // Of all that was added; nothing is added after it.
    std::array<uint8_t, kPageHashBytes> digest();

  private:
    static constexpr size_t kBlockBytes = 128;

    uint64_t state_[8];
    uint64_t num_bytes_ = 0;  // before those that wait
    unsigned char waiting_[kBlockBytes] = {};
    size_t num_waiting_ = 0;
};

}  // namespace v3dg

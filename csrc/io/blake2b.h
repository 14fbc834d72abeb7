#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace v3dg {

constexpr size_t kPageHashBytes = 16;

// BLAKE2b with a digest of 16 bytes and no key; RFC 7693.
std::array<uint8_t, kPageHashBytes> blake2b(const unsigned char* bytes, size_t size);

}  // namespace v3dg

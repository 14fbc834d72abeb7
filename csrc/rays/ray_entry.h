#pragma once

// Entries of the tiles of rays on a device: integers that sort by tile, then by
// distance.

#include <cstdint>
#include <cstring>

#include "base/host_device.h"

namespace v3dg {

// The lowest bits of an entry are the index of a record. The code of a distance is
// above them, and above it the index of the tile.
constexpr unsigned kRecordBits = 28;
constexpr uint32_t kMostRecords = (1u << kRecordBits) - 1;

// Distances are coded relative to the smallest distance. A code consists of six bits of
// the exponent and the whole mantissa of a float, of which the highest bits are used.
constexpr unsigned kDistanceBits = 29;
constexpr uint32_t kMostDistance = (1u << kDistanceBits) - 1;

// Returns the code of a distance in `bits` bits. Larger distances never have smaller
// codes.
V3DG_HD inline uint32_t code_of_distance(float distance, float nearest, unsigned bits) {
    const float x = distance > nearest ? distance : nearest;
    uint32_t of_x, of_nearest;
    std::memcpy(&of_x, &x, sizeof x);
    std::memcpy(&of_nearest, &nearest, sizeof nearest);
    const uint32_t difference = of_x - of_nearest;
    return (difference < kMostDistance ? difference : kMostDistance) >> (kDistanceBits - bits);
}

// Returns a lower bound of all distances whose code is at least `code`.
V3DG_HD inline float distance_of_code(uint32_t code, float nearest, unsigned bits) {
    uint32_t of_nearest;
    std::memcpy(&of_nearest, &nearest, sizeof nearest);
    const uint32_t of_distance = of_nearest + (code << (kDistanceBits - bits));
    float distance;
    std::memcpy(&distance, &of_distance, sizeof distance);
    return distance;
}

V3DG_HD inline uint64_t entry_of(uint32_t tile, uint32_t code, unsigned distance_bits,
                                 uint32_t record) {
    return (uint64_t(tile) << distance_bits | code) << kRecordBits | record;
}
V3DG_HD inline uint32_t record_of_entry(uint64_t entry) {
    return static_cast<uint32_t>(entry) & kMostRecords;
}
V3DG_HD inline uint32_t code_of_entry(uint64_t entry, unsigned distance_bits) {
    return static_cast<uint32_t>(entry >> kRecordBits) & ((1u << distance_bits) - 1);
}

}  // namespace v3dg

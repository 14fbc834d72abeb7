#pragma once

// Random numbers that are equal on every device.

#include <cstdint>

#include "base/host_device.h"

namespace v3dg {

// Returns random bits that depend only on seed + stream, and on the counter.
V3DG_HD inline uint64_t random_bits(uint64_t seed, uint64_t stream, uint64_t counter) {
    // Three rounds of splitmix64. The counter is added in the second round.
    uint64_t x = seed;
    const uint64_t more[3] = {stream, counter, 0};
    for (const uint64_t m : more) {
        x += 0x9e3779b97f4a7c15u + m;
        x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
        x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
        x ^= x >> 31;
    }
    return x;
}

// Returns a number that is uniform in [0, 1).
V3DG_HD inline double random_uniform(uint64_t seed, uint64_t stream, uint64_t counter) {
    return static_cast<double>(random_bits(seed, stream, counter) >> 11) * 0x1p-53;
}

}  // namespace v3dg

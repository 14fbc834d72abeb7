#include "io/blake2b.h"

#include <algorithm>
#include <cstring>
#include <utility>

namespace v3dg {

namespace {

constexpr uint64_t kStart[8] = {0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b,
                                0xa54ff53a5f1d36f1, 0x510e527fade682d1, 0x9b05688c2b3e6c1f,
                                0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};
constexpr uint8_t kOrder[10][16] = {
    {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
    {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
    {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
    {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
    {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
    {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
    {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
    {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
    {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
    {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
};

uint64_t rotated(uint64_t x, int bits) { return x >> bits | x << (64 - bits); }

void mix(uint64_t& a, uint64_t& b, uint64_t& c, uint64_t& d, uint64_t x, uint64_t y) {
    a += b + x;
    d = rotated(d ^ a, 32);
    c += d;
    b = rotated(b ^ c, 24);
    a += b + y;
    d = rotated(d ^ a, 16);
    c += d;
    b = rotated(b ^ c, 63);
}

void mix_round(uint64_t v[16], const uint64_t m[16], const uint8_t s[16]) {
    mix(v[0], v[4], v[8], v[12], m[s[0]], m[s[1]]);
    mix(v[1], v[5], v[9], v[13], m[s[2]], m[s[3]]);
    mix(v[2], v[6], v[10], v[14], m[s[4]], m[s[5]]);
    mix(v[3], v[7], v[11], v[15], m[s[6]], m[s[7]]);
    mix(v[0], v[5], v[10], v[15], m[s[8]], m[s[9]]);
    mix(v[1], v[6], v[11], v[12], m[s[10]], m[s[11]]);
    mix(v[2], v[7], v[8], v[13], m[s[12]], m[s[13]]);
    mix(v[3], v[4], v[9], v[14], m[s[14]], m[s[15]]);
}

// One after another without a loop: then the compiler knows which words go where.
template <size_t... kRounds>
void mix_rounds(uint64_t v[16], const uint64_t m[16], std::index_sequence<kRounds...>) {
    (mix_round(v, m, kOrder[kRounds % 10]), ...);
}

void add_block(uint64_t h[8], const unsigned char* block, uint64_t end, bool is_last) {
    uint64_t m[16], v[16];
    std::memcpy(m, block, sizeof m);
    for (int i = 0; i < 8; ++i) {
        v[i] = h[i];
        v[8 + i] = kStart[i];
    }
    v[12] ^= end;
    if (is_last) v[14] = ~v[14];
    mix_rounds(v, m, std::make_index_sequence<12>());
    for (int i = 0; i < 8; ++i) h[i] ^= v[i] ^ v[8 + i];
}

}  // namespace

Blake2b::Blake2b() {
    std::copy(kStart, kStart + 8, state_);
    state_[0] ^= 0x01010000 | kPageHashBytes;
}

// The last block, full or not, is hashed otherwise than the others: it waits until more comes.
void Blake2b::add(const unsigned char* bytes, size_t size) {
    const auto take = [&](size_t count) {
        if (count > 0) std::memcpy(waiting_ + num_waiting_, bytes, count);
        num_waiting_ += count;
        bytes += count;
        size -= count;
    };
    if (num_waiting_ > 0) take(std::min(size, kBlockBytes - num_waiting_));
    if (size == 0) return;
    if (num_waiting_ > 0) add_block(state_, waiting_, num_bytes_ += kBlockBytes, false);
    num_waiting_ = 0;
    for (; size > kBlockBytes; bytes += kBlockBytes, size -= kBlockBytes)
        add_block(state_, bytes, num_bytes_ += kBlockBytes, false);
    take(size);
}

std::array<uint8_t, kPageHashBytes> Blake2b::digest() {
    std::fill(waiting_ + num_waiting_, waiting_ + kBlockBytes, uint8_t{0});
    add_block(state_, waiting_, num_bytes_ + num_waiting_, true);
    std::array<uint8_t, kPageHashBytes> digest;
    std::memcpy(digest.data(), state_, digest.size());
    return digest;
}

std::array<uint8_t, kPageHashBytes> blake2b(const unsigned char* bytes, size_t size) {
    Blake2b hash;
    hash.add(bytes, size);
    return hash.digest();
}

}  // namespace v3dg

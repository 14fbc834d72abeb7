// BLAKE2b for 64-bit words or for vectors of words. The lanes of a vector hold either
// the words of several messages, or a row of the state of one message.

#include "io/blake2b_lanes.h"

#include <algorithm>
#include <cstring>
#include <utility>

#include "base/host_device.h"

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace v3dg {
namespace V3DG_ISA {

namespace {

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
using Rounds = std::make_index_sequence<12>;

template <int kBits>
V3DG_INLINE uint64_t rotated(uint64_t x) {
    return x >> kBits | x << (64 - kBits);
}

#if defined(__AVX2__)
typedef uint64_t Row __attribute__((vector_size(32)));

template <int kBits>
V3DG_INLINE Row rotated(Row x) {
    const auto bits = (__m256i)x;
#if defined(__AVX512VL__)
    return (Row)_mm256_ror_epi64(bits, kBits);
#else
    if constexpr (kBits == 63) return x >> 63 | (x + x);
    if constexpr (kBits == 32) return (Row)_mm256_shuffle_epi32(bits, 0xb1);
    constexpr int kBytes = kBits / 8;  // 2 or 3
    const auto order = [](int i) { return static_cast<char>((i & 8) | ((i + kBytes) & 7)); };
    const __m256i bytes = _mm256_setr_epi8(
        order(0), order(1), order(2), order(3), order(4), order(5), order(6), order(7), order(8),
        order(9), order(10), order(11), order(12), order(13), order(14), order(15), order(0),
        order(1), order(2), order(3), order(4), order(5), order(6), order(7), order(8), order(9),
        order(10), order(11), order(12), order(13), order(14), order(15));
    return (Row)_mm256_shuffle_epi8(bits, bytes);
#endif
}
#endif

#if defined(__AVX512F__)
typedef uint64_t Words __attribute__((vector_size(64)));

template <int kBits>
V3DG_INLINE Words rotated(Words x) {
    return (Words)_mm512_ror_epi64((__m512i)x, kBits);
}
#elif defined(__AVX2__)
using Words = Row;
#else
using Words = uint64_t;
#endif

// b is added last, because it is computed last
template <class V>
V3DG_INLINE void mix(V& a, V& b, V& c, V& d, V x, V y) {
    a = a + x + b;
    d = rotated<32>(d ^ a);
    c += d;
    b = rotated<24>(b ^ c);
    a = a + y + b;
    d = rotated<16>(d ^ a);
    c += d;
    b = rotated<63>(b ^ c);
}

template <size_t kRound, class V>
V3DG_INLINE void mix_round(V* v, const V* m) {
    constexpr const uint8_t* s = kOrder[kRound % 10];
    mix(v[0], v[4], v[8], v[12], m[s[0]], m[s[1]]);
    mix(v[1], v[5], v[9], v[13], m[s[2]], m[s[3]]);
    mix(v[2], v[6], v[10], v[14], m[s[4]], m[s[5]]);
    mix(v[3], v[7], v[11], v[15], m[s[6]], m[s[7]]);
    mix(v[0], v[5], v[10], v[15], m[s[8]], m[s[9]]);
    mix(v[1], v[6], v[11], v[12], m[s[10]], m[s[11]]);
    mix(v[2], v[7], v[8], v[13], m[s[12]], m[s[13]]);
    mix(v[3], v[4], v[9], v[14], m[s[14]], m[s[15]]);
}

// The rounds are unrolled, so that the order of message words in each round is known at
// compile time.
template <class V, size_t... kRounds>
V3DG_INLINE void mix_rounds(V* v, const V* m, std::index_sequence<kRounds...>) {
    (mix_round<kRounds>(v, m), ...);
}

// Adds one block. `end` is the number of bytes up to the end of this block. `last` has
// all bits set for the last block, and none for others.
template <class V>
V3DG_INLINE void compress(V* h, const V* m, V end, V last) {
    V v[16];
    for (int i = 0; i < 8; ++i) {
        v[i] = h[i];
        v[8 + i] = V{} + kHashConstant[i];
    }
    v[12] ^= end;
    v[14] ^= last;
    mix_rounds(v, m, Rounds());
    for (int i = 0; i < 8; ++i) h[i] ^= v[i] ^ v[8 + i];
}

#if defined(__AVX2__)

// Rotates a row of four words by kLanes lanes.
template <int kLanes>
V3DG_INLINE Row turned(Row x) {
    constexpr auto source = [](int i) { return (i + kLanes) & 3; };
    constexpr int kOrderOfLanes = source(0) | source(1) << 2 | source(2) << 4 | source(3) << 6;
    return (Row)_mm256_permute4x64_epi64((__m256i)x, kOrderOfLanes);
}

V3DG_INLINE uint64_t word(const unsigned char* block, int i) {
    uint64_t word;
    std::memcpy(&word, block + sizeof word * i, sizeof word);
    return word;
}

// To form the diagonals, rotate all rows except b, because b is computed last.
template <size_t kRound>
V3DG_INLINE void mix_rows(Row& a, Row& b, Row& c, Row& d, const unsigned char* block) {
    constexpr const uint8_t* s = kOrder[kRound % 10];
    const auto m = [&](int i) { return word(block, s[i]); };
    mix(a, b, c, d, Row{m(0), m(2), m(4), m(6)}, Row{m(1), m(3), m(5), m(7)});
    a = turned<3>(a);
    c = turned<1>(c);
    d = turned<2>(d);
    mix(a, b, c, d, Row{m(14), m(8), m(10), m(12)}, Row{m(15), m(9), m(11), m(13)});
    a = turned<1>(a);
    c = turned<3>(c);
    d = turned<2>(d);
}

template <size_t... kRounds>
V3DG_INLINE void mix_all_rows(Row& a, Row& b, Row& c, Row& d, const unsigned char* block,
                              std::index_sequence<kRounds...>) {
    (mix_rows<kRounds>(a, b, c, d, block), ...);
}

V3DG_INLINE void compress_one(uint64_t* state, const unsigned char* block, uint64_t end,
                              uint64_t last) {
    Row h[2], start[2];
    std::memcpy(h, state, sizeof h);
    std::memcpy(start, kHashConstant, sizeof start);
    Row a = h[0], b = h[1], c = start[0], d = start[1] ^ Row { end, 0, last, 0 };
    mix_all_rows(a, b, c, d, block, Rounds());
    h[0] ^= a ^ c;
    h[1] ^= b ^ d;
    std::memcpy(state, h, sizeof h);
}

#else

V3DG_INLINE void compress_one(uint64_t* state, const unsigned char* block, uint64_t end,
                              uint64_t last) {
    uint64_t m[16];
    std::memcpy(m, block, sizeof m);
    compress(state, m, end, last);
}

#endif

}  // namespace

void add_blocks(uint64_t* state, uint64_t num_bytes, const unsigned char* blocks,
                size_t num_blocks) {
    for (size_t i = 0; i < num_blocks; ++i, blocks += kHashBlockBytes)
        compress_one(state, blocks, num_bytes += kHashBlockBytes, 0);
}

void add_last_block(uint64_t* state, uint64_t num_bytes, const unsigned char* block) {
    compress_one(state, block, num_bytes, ~uint64_t{0});
}

// Returns the digest of a message. `state` includes the first `num_bytes` bytes, and
// `rest` has the remaining ones.
static PageHash digest_of_rest(uint64_t* state, uint64_t num_bytes, const unsigned char* rest,
                               size_t size) {
    const size_t whole = size > 0 ? (size - 1) / kHashBlockBytes : 0,
                 added = whole * kHashBlockBytes;
    add_blocks(state, num_bytes, rest, whole);
    unsigned char last[kHashBlockBytes] = {};
    if (size > 0) std::memcpy(last, rest + added, size - added);
    add_last_block(state, num_bytes + size, last);
    PageHash digest;
    std::memcpy(&digest, state, sizeof digest);
    return digest;
}

#if defined(__AVX2__)

namespace {

constexpr size_t kNumLanes = sizeof(Words) / sizeof(uint64_t);
constexpr unsigned char kZeros[kHashBlockBytes] = {};

// Sets m[w] to word w of the blocks of all lanes.
#if defined(__AVX512F__)

V3DG_INLINE void load_words(const unsigned char* const* blocks, Words* m) {
    for (int half = 0; half < 2; ++half) {
        __m512i rows[8];
        for (int i = 0; i < 8; ++i) rows[i] = _mm512_loadu_si512(blocks[i] + 64 * half);
        for (int odd = 0; odd < 2; ++odd) {
            __m512i pairs[4];  // in each lane: words odd, odd + 2, odd + 4, odd + 6
            __m512i fours[4];  // in each lane: two of the words in `pairs`
            for (int i = 0; i < 4; ++i)
                pairs[i] = odd ? _mm512_unpackhi_epi64(rows[2 * i], rows[2 * i + 1])
                               : _mm512_unpacklo_epi64(rows[2 * i], rows[2 * i + 1]);
            for (int i = 0; i < 2; ++i) {
                // words odd and odd + 4
                fours[i] = _mm512_shuffle_i64x2(pairs[2 * i], pairs[2 * i + 1], 0x88);
                fours[2 + i] =
                    // words odd + 2 and odd + 6
                    _mm512_shuffle_i64x2(pairs[2 * i], pairs[2 * i + 1], 0xdd);
            }
            for (int i = 0; i < 2; ++i) {
                Words* words = m + 8 * half + odd + 2 * i;
                words[0] = (Words)_mm512_shuffle_i64x2(fours[2 * i], fours[2 * i + 1], 0x88);
                words[4] = (Words)_mm512_shuffle_i64x2(fours[2 * i], fours[2 * i + 1], 0xdd);
            }
        }
    }
}

#else

V3DG_INLINE void load_words(const unsigned char* const* blocks, Words* m) {
    for (int part = 0; part < 4; ++part) {
        __m256i rows[4];
        for (int i = 0; i < 4; ++i)
            rows[i] = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(blocks[i] + 32 * part));
        for (int odd = 0; odd < 2; ++odd) {
            __m256i pairs[2];  // in each lane: words odd and odd + 2
            for (int i = 0; i < 2; ++i)
                pairs[i] = odd ? _mm256_unpackhi_epi64(rows[2 * i], rows[2 * i + 1])
                               : _mm256_unpacklo_epi64(rows[2 * i], rows[2 * i + 1]);
            m[4 * part + odd] = (Words)_mm256_permute2x128_si256(pairs[0], pairs[1], 0x20);
            m[4 * part + odd + 2] = (Words)_mm256_permute2x128_si256(pairs[0], pairs[1], 0x31);
        }
    }
}

#endif

// Messages that are hashed together, one per lane. An idle lane hashes zeros.
class Lanes {
  public:
    bool is_busy(size_t lane) const { return digest_[lane] != nullptr; }
    void begin(size_t lane, Span<const uint8_t> message, PageHash* digest) {
        digest_[lane] = digest;
        rest_[lane] = message.data;
        left_[lane] = message.size;
        end_[lane] = 0;
        for (int i = 0; i < 8; ++i) state_[i][lane] = kHashStart[i];
    }
    // Adds blocks to all messages until one of them ends. Stores the digests of
    // messages that have ended.
    void advance() {
        size_t whole = SIZE_MAX;
        for (size_t k = 0; k < kNumLanes; ++k)
            if (is_busy(k))
                whole = std::min(whole, left_[k] > 0 ? (left_[k] - 1) / kHashBlockBytes : 0);
        add(whole);
        add_where_one_is_last();
    }
    // Hashes the rest of one message alone.
    void finish(size_t lane) {
        uint64_t state[8];
        for (int i = 0; i < 8; ++i) state[i] = state_[i][lane];
        *digest_[lane] = digest_of_rest(state, end_[lane], rest_[lane], left_[lane]);
        digest_[lane] = nullptr;
    }

  private:
    void add(size_t num_blocks) {
        const unsigned char* blocks[kNumLanes];
        size_t step[kNumLanes];
        for (size_t k = 0; k < kNumLanes; ++k) {
            blocks[k] = is_busy(k) ? rest_[k] : kZeros;
            step[k] = is_busy(k) ? kHashBlockBytes : 0;
        }
        for (size_t i = 0; i < num_blocks; ++i) {
            Words m[16];
            load_words(blocks, m);
            compress(state_, m, end_ += Words{} + kHashBlockBytes, Words{});
            for (size_t k = 0; k < kNumLanes; ++k) blocks[k] += step[k];
        }
        for (size_t k = 0; k < kNumLanes; ++k) {
            rest_[k] = blocks[k];
            left_[k] -= num_blocks * step[k];
        }
    }
    void add_where_one_is_last() {
        unsigned char filled[kNumLanes][kHashBlockBytes] = {};
        const unsigned char* blocks[kNumLanes];
        Words last = {}, m[16];
        for (size_t k = 0; k < kNumLanes; ++k) {
            const size_t size = is_busy(k) ? std::min(left_[k], kHashBlockBytes) : 0;
            last[k] = is_busy(k) && size == left_[k] ? ~uint64_t{0} : 0;
            if (size > 0) std::memcpy(filled[k], rest_[k], size);
            blocks[k] = filled[k];
            rest_[k] += size;
            left_[k] -= size;
            end_[k] += size;
        }
        load_words(blocks, m);
        compress(state_, m, end_, last);
        for (size_t k = 0; k < kNumLanes; ++k) {
            if (last[k] == 0) continue;
            const uint64_t digest[2] = {state_[0][k], state_[1][k]};
            std::memcpy(digest_[k]->data(), digest, sizeof digest);
            digest_[k] = nullptr;
        }
    }

    Words state_[8] = {}, end_ = {};             // end_: number of bytes that were added
    const unsigned char* rest_[kNumLanes] = {};  // bytes that are not hashed yet
    size_t left_[kNumLanes] = {};
    PageHash* digest_[kNumLanes] = {};  // null if the lane is idle
};

}  // namespace

void hash_messages(Span<const Span<const uint8_t>> messages, PageHash* digests) {
    Lanes lanes;
    for (size_t next = 0, num_busy = 0;;) {
        size_t one_busy = 0;
        num_busy = 0;
        for (size_t k = 0; k < kNumLanes; ++k) {
            if (!lanes.is_busy(k) && next < messages.size) {
                lanes.begin(k, messages[next], digests + next);
                ++next;
            }
            if (!lanes.is_busy(k)) continue;
            one_busy = k;
            ++num_busy;
        }
        if (num_busy == 1) lanes.finish(one_busy);
        if (num_busy <= 1) return;
        lanes.advance();
    }
}

#else

void hash_messages(Span<const Span<const uint8_t>> messages, PageHash* digests) {
    for (size_t i = 0; i < messages.size; ++i) {
        uint64_t state[8];
        std::copy(kHashStart, kHashStart + 8, state);
        digests[i] = digest_of_rest(state, 0, messages[i].data, messages[i].size);
    }
}

#endif

}  // namespace V3DG_ISA
}  // namespace v3dg

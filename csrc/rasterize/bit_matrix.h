#pragma once

// Transposes square matrices of bits. Included only by sources that are compiled once
// per instruction set.

#include <cstddef>
#include <cstdint>

#include "math/simd.h"

namespace v3dg {
namespace V3DG_ISA {

constexpr int kMatrixBits = 64;

#if defined(__AVX512BW__)

// Returns a vector whose quarter q has words 16 q + 2 k and 16 q + 2 k + 1.
V3DG_INLINE __m512i load_word_pairs(const uint64_t* words, int k) {
    const auto pair = [&](int quarter) {
        return _mm_loadu_si128(reinterpret_cast<const __m128i*>(words + 16 * quarter + 2 * k));
    };
    __m512i out = _mm512_castsi128_si512(pair(0));
    out = _mm512_inserti64x2(out, pair(1), 1);
    out = _mm512_inserti64x2(out, pair(2), 2);
    return _mm512_inserti64x2(out, pair(3), 3);
}

// Sets `bytes[r]` to byte r of each of the 64 words.
V3DG_INLINE void split_bytes(const uint64_t* words, __m512i bytes[8]) {
    // Makes words of 16 bits: byte r of two adjacent words.
    const __m512i interleaved =
        _mm512_broadcast_i32x4(_mm_setr_epi8(0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15));
    __m512i a[8], b[8];
    for (int k = 0; k < 8; ++k) a[k] = _mm512_shuffle_epi8(load_word_pairs(words, k), interleaved);
    // Transposes the 8 x 8 words of 16 bits in each quarter.
    for (int k = 0; k < 8; k += 2) {
        b[k] = _mm512_unpacklo_epi16(a[k], a[k + 1]);
        b[k + 1] = _mm512_unpackhi_epi16(a[k], a[k + 1]);
    }
    for (int k = 0; k < 2; ++k) {
        a[4 * k] = _mm512_unpacklo_epi32(b[k], b[k + 2]);
        a[4 * k + 1] = _mm512_unpackhi_epi32(b[k], b[k + 2]);
        a[4 * k + 2] = _mm512_unpacklo_epi32(b[k + 4], b[k + 6]);
        a[4 * k + 3] = _mm512_unpackhi_epi32(b[k + 4], b[k + 6]);
    }
    for (int k = 0; k < 2; ++k)
        for (int half = 0; half < 2; ++half) {
            bytes[4 * k + 2 * half] = _mm512_unpacklo_epi64(a[4 * k + half], a[4 * k + 2 + half]);
            bytes[4 * k + 2 * half + 1] =
                _mm512_unpackhi_epi64(a[4 * k + half], a[4 * k + 2 + half]);
        }
}

#endif

// Sets bit i of out[k * stride] to bit k of in[i].
V3DG_INLINE void transpose_bits(const uint64_t in[kMatrixBits], size_t stride, uint64_t* out) {
#if defined(__AVX512BW__)
    __m512i bytes[8];
    split_bytes(in, bytes);
    for (int r = 0; r < 8; ++r)
        for (int bit = 0; bit < 8; ++bit)
            out[(8 * r + bit) * stride] =
                _mm512_test_epi8_mask(bytes[r], _mm512_set1_epi8(static_cast<char>(1 << bit)));
#else
    uint64_t rows[kMatrixBits];
    for (int i = 0; i < kMatrixBits; ++i) rows[i] = in[i];
    // Exchanges the off-diagonal blocks of ever smaller square blocks.
    uint64_t low = 0x00000000ffffffffu;
    for (int size = kMatrixBits / 2; size != 0; size /= 2, low ^= low << size)
        for (int first = 0; first < kMatrixBits; first += 2 * size)
            for (int i = first; i < first + size; ++i) {
                const uint64_t exchanged = ((rows[i] >> size) ^ rows[i + size]) & low;
                rows[i] ^= exchanged << size;
                rows[i + size] ^= exchanged;
            }
    for (size_t i = 0; i < kMatrixBits; ++i) out[i * stride] = rows[i];
#endif
}

}  // namespace V3DG_ISA
}  // namespace v3dg

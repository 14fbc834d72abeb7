#pragma once

// The records of a tile that are blended together on the CPU, and which of them may
// change each strip of a block.

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "rasterize/bit_matrix.h"
#include "rasterize/simd_tile.h"

namespace v3dg {
namespace V3DG_ISA {

// The largest number of records in a batch. It is large enough that a strip has several
// records, and small enough that what a strip reads of the batch fits into the L1
// cache.
constexpr int kBatchSize = 512;
constexpr int kBatchWords = kBatchSize / kMatrixBits;
// The largest number of (record, block) pairs in a batch. With large records it keeps
// batches short, so that fewer records are loaded that turn out to be hidden.
constexpr int kBatchBlocks = 2048;

// The first part of a record, which blending reads. The centre is in px from the tile's
// corner.
template <class T>
struct BatchRecord {
    T u, v, l11, l12, l22, log2_opacity;
    T color[3];
    T depth;

    V3DG_INLINE void take(const Record<T>& g, int left, int top) {
        static_assert(
            sizeof *this <= sizeof g && offsetof(Record<T>, depth) == offsetof(BatchRecord, depth),
            "BatchRecord must have the layout of the first part of a Record");
        std::memcpy(static_cast<void*>(this), &g, sizeof *this);
        u = g.u - T(left);
        v = g.v - T(top);
    }
};

// Prefetches a record into the L2 cache, which supports more outstanding cache lines
// than the L1 cache. A record may straddle two cache lines.
template <class T>
V3DG_INLINE void prefetch_record(const Record<T>* record) {
    constexpr int kRead = 0, kSecondLevel = 2;
    __builtin_prefetch(record, kRead, kSecondLevel);
    __builtin_prefetch(reinterpret_cast<const char*>(record + 1) - 1, kRead, kSecondLevel);
}

// A batch of records of a tile, front to back, and the records of each block.
template <class T>
struct Batch {
    int size;
    const Record<T>* source[1 + kBatchSize];  // index 1 is the first record
    uint64_t blocks[kBatchSize];              // blocks that each record's box touches
    BatchRecord<T> record[kBatchSize];
    // Bit b of strips[s][i] says whether record i may change strip s of block b.
    uint64_t strips[kStrips][kBatchSize];
    // The same as bit i % 64 of of_strip[s][b][i / 64].
    uint64_t of_strip[kStrips][kTileBlocks * kTileBlocks][kBatchWords];
};

// A record of a tile's list, and the blocks that its box touches.
template <class T>
struct Listed {
    const Record<T>* record;
    uint64_t blocks;
};

// The list of a tile.
template <class T>
struct ListedEntries {
    const Record<T>* records;
    EntryFormat format;
    const uint64_t* entry;

    V3DG_INLINE Listed<T> operator()(size_t i) const {
        return {records + format.record_of(entry[i]), EntryFormat::blocks_of(entry[i])};
    }
};

// Adds records to the batch, from index i on, until it is full. Returns the index of
// the next record. Only records whose boxes touch live blocks are added, and loaded.
// The loop has no branch, because it would be mispredicted often.
template <class T, class ListedAt>
V3DG_INLINE size_t take_live(size_t i, size_t count, uint64_t alive, const ListedAt& listed_at,
                             Batch<T>& batch) {
    int size = 0, num_blocks = 0;
    // Prefetch this record while the batch is empty.
    batch.source[0] = listed_at(i).record;
    for (; i < count && size < kBatchSize && num_blocks < kBatchBlocks; ++i) {
        const Listed<T> g = listed_at(i);
        const uint64_t blocks = g.blocks & alive;
        batch.source[1 + size] = g.record;
        batch.blocks[size] = blocks;
        size += blocks != 0;
        num_blocks += __builtin_popcountll(blocks);
        prefetch_record(batch.source[size]);
    }
    batch.size = size;
    return i;
}

#if defined(__AVX512F__)

// The blocks from each column or row of blocks on, and up to it.
struct BlocksOfEdges {
    uint64_t from_column[kTileBlocks] = {}, to_column[kTileBlocks] = {};
    uint64_t from_row[kTileBlocks] = {}, to_row[kTileBlocks] = {};
    constexpr BlocksOfEdges() {
        constexpr int kLast = kTileBlocks - 1;
        for (int k = 0; k < kTileBlocks; ++k) {
            from_column[k] = kBlocksOfBox.columns[kLast << 3 | k];
            to_column[k] = kBlocksOfBox.columns[k << 3];
            from_row[k] = kBlocksOfBox.rows[kLast << 3 | k];
            to_row[k] = kBlocksOfBox.rows[k << 3];
        }
    }
};
inline constexpr BlocksOfEdges kBlocksOfEdges;

// Returns EntryFormat::blocks_of() for eight entries.
V3DG_INLINE __m512i blocks_of_entries(__m512i entries) {
    // A permutation reads only the lowest three bits of an index.
    const auto look_up = [&](int shift, const uint64_t* table) {
        return _mm512_permutexvar_epi64(_mm512_srli_epi64(entries, shift),
                                        _mm512_loadu_si512(table));
    };
    return _mm512_and_si512(
        _mm512_and_si512(look_up(0, kBlocksOfEdges.from_column),
                         look_up(3, kBlocksOfEdges.to_column)),
        _mm512_and_si512(look_up(6, kBlocksOfEdges.from_row), look_up(9, kBlocksOfEdges.to_row)));
}

// Like the function above, eight entries at once.
V3DG_INLINE size_t take_live(size_t i, size_t count, uint64_t alive,
                             const ListedEntries<float>& list, Batch<float>& batch) {
    constexpr int kTogether = 8;
    const __m512i live = _mm512_set1_epi64(static_cast<int64_t>(alive));
    const __m512i first = _mm512_set1_epi64(reinterpret_cast<int64_t>(list.records));
    const __m512i low = _mm512_set1_epi64((int64_t(1) << list.format.depth_shift) - 1);
    int size = 0, num_blocks = 0;
    batch.source[0] = list(i).record;
    for (; i < count && size <= kBatchSize - kTogether && num_blocks < kBatchBlocks;
         i += kTogether) {
        const size_t left = count - i;
        const __mmask8 are_listed =
            static_cast<__mmask8>(left < kTogether ? (1u << left) - 1 : 0xffu);
        const __m512i entries = _mm512_maskz_loadu_epi64(are_listed, list.entry + i);
        const __m512i blocks = _mm512_maskz_and_epi64(are_listed, blocks_of_entries(entries), live);
        const __mmask8 are_live = _mm512_test_epi64_mask(blocks, blocks);
        static_assert(sizeof(Record<float>) == 32 + 16,
                      "The shifts must give the size of a record");
        const __m512i place =
            _mm512_srli_epi64(_mm512_and_si512(entries, low), EntryFormat::kBoxBits);
        const __m512i source = _mm512_add_epi64(
            first, _mm512_add_epi64(_mm512_slli_epi64(place, 5), _mm512_slli_epi64(place, 4)));
        // Lanes behind the last one repeat the record before, so that it is prefetched.
        const __m512i before = _mm512_set1_epi64(reinterpret_cast<int64_t>(batch.source[size]));
        _mm512_storeu_si512(batch.source + 1 + size,
                            _mm512_mask_compress_epi64(before, are_live, source));
        _mm512_storeu_si512(batch.blocks + size, _mm512_maskz_compress_epi64(are_live, blocks));
        for (int k = 0; k < kTogether; ++k) {
            num_blocks += __builtin_popcountll(batch.blocks[size + k]);
            prefetch_record(batch.source[1 + size + k]);
        }
        size += __builtin_popcount(are_live);
    }
    batch.size = size;
    return i < count ? i : count;
}

#endif

// The number of touched strips from which on the exact test pays off.
constexpr int kFewStrips = 16;

// Finds the strips that each record may change, and the records of each strip.
template <class T>
V3DG_INLINE void sort_into_strips(int left, int top, const StripMask& alive, Batch<T>& batch) {
    uint16_t many[kBatchSize];
    int num_many = 0;
    for (int i = 0; i < batch.size; ++i) {
        const Record<T>& g = *batch.source[1 + i];
        batch.record[i].take(g, left, top);
        const StripMask box = strips_of_box(g, top, batch.blocks[i]);
        for (int s = 0; s < kStrips; ++s) batch.strips[s][i] = box.strip[s] & alive.strip[s];
        many[num_many] = static_cast<uint16_t>(i);
        num_many += box.size() >= kFewStrips;
    }
    for (int k = 0; k < num_many; ++k) {
        const int i = many[k];
        const StripMask reached = strips_of_ellipse(*batch.source[1 + i], left, top);
        for (int s = 0; s < kStrips; ++s) batch.strips[s][i] &= reached.strip[s];
    }
    const int end = (batch.size + kMatrixBits - 1) / kMatrixBits * kMatrixBits;
    for (int s = 0; s < kStrips; ++s) {
        for (int i = batch.size; i < end; ++i) batch.strips[s][i] = 0;
        for (int i = 0; i < end; i += kMatrixBits)
            transpose_bits(batch.strips[s] + i, kBatchWords,
                           &batch.of_strip[s][0][i / kMatrixBits]);
        for (auto& words : batch.of_strip[s])
            for (int w = end / kMatrixBits; w < kBatchWords; ++w) words[w] = 0;
    }
}

// Iterates over the records of a batch that may change one strip, front to back. To
// proceed to the next word of bits takes no branch, because none could be predicted.
class StripRecords {
  public:
    // `words` has a bit for each record of a batch.
    explicit V3DG_INLINE StripRecords(const uint64_t words[kBatchWords]) {
        for (int w = 0; w < kBatchWords; ++w) size_ += __builtin_popcountll(words[w]);
        skip_empty(words);
        left_ = word_[0];
    }
    V3DG_INLINE int size() const { return size_; }
    // Returns the index of the next record in the batch. Precondition: there is one.
    V3DG_INLINE size_t next() {
        const size_t record = first_[at_] + __builtin_ctzll(left_);
        left_ &= left_ - 1;
        const bool is_last = left_ == 0;
        at_ += is_last;
        left_ |= word_[at_] & -uint64_t(is_last);
        return record;
    }

  private:
    // Sets word_ and first_ to the words that are not 0, and their first records.
    V3DG_INLINE void skip_empty(const uint64_t words[kBatchWords]) {
#if defined(__AVX512F__)
        static_assert(kBatchWords == 8, "The words must fill a vector");
        const __m512i all = _mm512_loadu_si512(words);
        const __mmask8 is_set = _mm512_test_epi64_mask(all, all);
        const __m512i first = _mm512_setr_epi64(0, 64, 128, 192, 256, 320, 384, 448);
        _mm512_storeu_si512(word_, _mm512_maskz_compress_epi64(is_set, all));
        _mm512_storeu_si512(first_, _mm512_maskz_compress_epi64(is_set, first));
#else
        size_t count = 0;
        for (size_t w = 0; w < kBatchWords; ++w) {
            word_[count] = words[w];
            first_[count] = kMatrixBits * w;
            count += words[w] != 0;
        }
#endif
    }

    uint64_t word_[kBatchWords + 1];  // the word behind the last one is never used
    size_t first_[kBatchWords + 1];
    uint64_t left_;
    int size_ = 0;
    size_t at_ = 0;
};

}  // namespace V3DG_ISA
}  // namespace v3dg

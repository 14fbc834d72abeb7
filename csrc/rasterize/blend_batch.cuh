#pragma once

// Blends a batch of records, nearest first, over the pixels of a tile.
//
// Many gaussians cover only a few pixels, so testing every record at every pixel would
// be slow. Instead, a warp processes 32 records at once: each lane computes a bit mask
// of the pixels that one record reaches. The masks are then transposed, so that each
// pixel visits only its own records.
//
// If gaussians cover many pixels, a lane blends two adjacent pixels, which share most
// records, loads and terms of a row. A sub-tile then has 16 x 4 pixels instead of 8 x
// 4. A pixel gets the same bits in both cases.

#include <type_traits>

#include "rasterize/piece_sort.cuh"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

static_assert(SubTile<2>::kColumns == 2 && SubTile<2>::kHeight == 4 && kEntryBlockSize == 4,
              "place_of(), subs_of(), publish_alive() and reached_cells() require it");

// The pixels that a lane blends.
template <int kPixels>
struct BlendedPixels {
    float x[kPixels], y;  // pixel centres
    float transmittance[kPixels];
    float color[3][kPixels];
    float depth[kPixels];
};

// Returns the index in TilePixels of a lane's first pixel.
template <int kPixels>
__device__ unsigned place_of(unsigned sub, unsigned lane) {
    if (kPixels == 1) return 32 * sub + (lane ^ (16 * (sub % 2)));
    const unsigned column = lane / 4 % 2;
    return 64 * sub + 32 * column + ((8 * (lane / 8) + 2 * (lane % 4)) ^ (16 * column));
}
__device__ inline void load(const float* from, float (&to)[1]) { to[0] = *from; }
__device__ inline void load(const float* from, float (&to)[2]) {
    const float2 both = *reinterpret_cast<const float2*>(from);
    to[0] = both.x, to[1] = both.y;
}
__device__ inline void store(const float (&from)[1], float* to) { *to = from[0]; }
__device__ inline void store(const float (&from)[2], float* to) {
    *reinterpret_cast<float2*>(to) = {from[0], from[1]};
}

// Load part of a record from an address in shared memory. The asm has no memory
// clobber, so the compiler may move it across plain stores. This is safe, because only
// copy_async() writes records, and the caller has waited for it.
template <int kVector>
__device__ float4 vector_at(uint32_t place) {
    float4 v{};
#ifdef __CUDA_ARCH__
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4 + %5];"
                 : "=f"(v.x), "=f"(v.y), "=f"(v.z), "=f"(v.w)
                 : "r"(place), "n"(kVector * int(sizeof(float4)) * kBlendBatch));
#endif
    return v;
}
__device__ inline float2 rest_at(uint32_t place) {
    float2 v{};
#ifdef __CUDA_ARCH__
    asm volatile("ld.shared.v2.f32 {%0, %1}, [%2 + %3];"
                 : "=f"(v.x), "=f"(v.y)
                 : "r"(place), "n"(kEllipseVectors * int(sizeof(float4)) * kBlendBatch));
#endif
    return v;
}

// Writes an element of BlendShared::list, given its address in shared memory.
__device__ inline void list_record(uint32_t place, uint32_t record) {
#ifdef __CUDA_ARCH__
    asm volatile("st.shared.u16 [%0], %1;" ::"r"(place), "h"(static_cast<uint16_t>(record)));
#endif
}

// Reads an element of BlendShared::list, and extends it to 32 bits. For a plain load,
// nvcc would add an instruction for the extension. The code that writes the list ends
// with a memory clobber, so the load comes after the writes.
__device__ inline uint32_t listed_at(uint32_t place) {
    uint32_t listed = 0;
#ifdef __CUDA_ARCH__
    asm volatile("ld.shared.u16 %0, [%1];" : "=r"(listed) : "r"(place));
#endif
    return listed;
}

// Returns the lowest `count` bits. The asm is a single instruction. Precondition:
// `count` < 32.
__device__ inline uint32_t low_bits(uint32_t bits, uint32_t count) {
    uint32_t low = 0;
#ifdef __CUDA_ARCH__
    asm("szext.clamp.u32 %0, %1, %2;" : "=r"(low) : "r"(bits), "r"(count));
#endif
    return low;
}

// Returns a mask of the tile's blocks that are inside a sub-tile.
template <int kPixels>
__device__ uint32_t blocks_of_sub(unsigned sub) {
    return ((1u << SubTile<kPixels>::kBlocks) - 1) << SubTile<kPixels>::kBlocks * sub;
}

// Returns a mask of the sub-tiles that contain any of `blocks`. The bit of a sub-tile
// is the bit of its first block.
template <int kPixels>
__device__ uint32_t subs_of(uint32_t blocks) {
    blocks |= blocks >> 1;
    return kPixels == 1 ? blocks & 0x55555555u : (blocks | blocks >> 2) & 0x11111111u;
}

// Removes blocks from s.alive_blocks if all of their pixels have stopped.
template <int kPixels, class Shared>
__device__ void publish_alive(bool is_alive, unsigned sub, Shared& s) {
    constexpr int kAcross = kEntryBlockSize / kPixels;  // lanes per row of a block
    const uint32_t alive = __ballot_sync(kAllLanes, is_alive);
    uint32_t dead = 0;
#pragma unroll
    for (int block = 0; block < SubTile<kPixels>::kBlocks; ++block) {
        const uint32_t lanes = ((1u << kAcross) - 1) * 0x01010101u << kAcross * block;
        dead |= ((alive & lanes) == 0) << block;
    }
    if (dead != 0 && threadIdx.x % 32 == 0)
        atomicAnd(&s.alive_blocks, ~(dead << SubTile<kPixels>::kBlocks * sub));
}

// Transposes a matrix of bits: bit j of lane i becomes bit i of lane j.
__device__ inline uint32_t transpose_bits(uint32_t bits) {
    const unsigned lane = threadIdx.x % 32;
    // Exchange whole 16-bit halves between lanes i and i ^ 16, then bytes between lanes
    // i and i ^ 8.
    bits =
        __byte_perm(bits, __shfl_xor_sync(kAllLanes, bits, 16), (lane & 16) != 0 ? 0x3276 : 0x5410);
    bits =
        __byte_perm(bits, __shfl_xor_sync(kAllLanes, bits, 8), (lane & 8) != 0 ? 0x3715 : 0x6240);
    uint32_t low_half = 0x0f0f0f0f;
#pragma unroll
    for (unsigned width = 4; width > 0; width /= 2) {
        const bool upper = (lane & width) != 0;
        const uint32_t kept_bits = upper ? ~low_half : low_half;
        const uint32_t other = __shfl_xor_sync(kAllLanes, bits, width);
        bits = (bits & kept_bits) |
               (__funnelshift_l(other, other, upper ? 32 - width : width) & ~kept_bits);
        low_half ^= low_half << (width / 2);
    }
    return bits;
}

// Copies the stop rule into a register. As a kernel argument, nvcc would load it again
// for each gaussian.
template <class Stop, class Shared>
__device__ Stop stop_of(const Shared& s) {
    if constexpr (std::is_same_v<Stop, StopsBefore>)
        return {};
    else
        return {s.stops_behind};
}

// Blends the batch over one sub-tile. All lanes of the warp must call it.
template <int kPixels, bool kWithDepth, class Stop, class Shared>
__device__ void blend_sub(unsigned sub, int left, int top, Shared& s) {
    const Stop stop = stop_of<Stop>(s);
    unsigned lane = threadIdx.x % 32;
    // The asm hides from the compiler where `lane` comes from. Otherwise, nvcc would
    // keep values derived from it in registers between batches, and spill other values.
    asm volatile("" : "+r"(lane));
    // The list is filled from the end of the array to its beginning.
    constexpr uint32_t kEach = sizeof(s.list[0][0]);
    const auto list =
        static_cast<uint32_t>(__cvta_generic_to_shared(s.list[threadIdx.x / 32] + kBlendBatch));
    const auto record = static_cast<uint32_t>(__cvta_generic_to_shared(&s.record[0][lane]));
    const uint32_t own_blocks = blocks_of_sub<kPixels>(sub);
    int listed = 0;
#pragma unroll
    for (int g = 0; g < kBlendBatch / 32; ++g) {
        const bool reaches = (s.blocks[32 * g + lane] & own_blocks) != 0;
        const uint32_t reaching = __ballot_sync(kAllLanes, reaches);
        const int place = listed + __popc(reaching & ((1u << lane) - 1));
        if (reaches) list_record(list - kEach * place, record + g * 32 * sizeof(float4));
        listed += __popc(reaching);
    }
    __syncwarp();
    // The asm orders the list's stores before the loads of listed_at().
    asm volatile("" ::: "memory");

    using Sub = SubTile<kPixels>;
    const float corner_x = static_cast<float>(left + sub % Sub::kColumns * Sub::kWidth) + 0.5f;
    const float corner_y = static_cast<float>(top + sub / Sub::kColumns * Sub::kHeight) + 0.5f;
    TilePixels& pixels = s.pixels;
    const unsigned place = place_of<kPixels>(sub, lane);
    BlendedPixels<kPixels> p;
    for (int k = 0; k < kPixels; ++k)
        p.x[k] = corner_x + static_cast<float>(kPixels * (lane % 8) + k);
    p.y = corner_y + static_cast<float>(lane / 8);
    load(pixels.transmittance + place, p.transmittance);
    for (int c = 0; c < 3; ++c) load(pixels.color[c] + place, p.color[c]);
    if (kWithDepth) load(s.depth + place, p.depth);
    // If one of a lane's two pixels has stopped, it is moved to infinity, where no
    // gaussian reaches it.
    constexpr float kNowhere = INFINITY;
    bool alive = false;
    for (int k = 0; k < kPixels; ++k) {
        if (p.transmittance[k] > 0)
            alive = true;
        else
            p.x[k] = kNowhere;
    }
    // The last lane takes the first record of a group of 32, so that this record
    // becomes the highest bit in the masks of pixels.
    uint32_t last_of_group = list - 31 * kEach;
    for (; listed > 0; listed -= 32, last_of_group -= 32 * kEach) {
        uint32_t bits = 0;
        if (static_cast<int>(31 - lane) < listed) {
            const uint32_t own_record = listed_at(last_of_group + kEach * lane);
            const float4 a = vector_at<0>(own_record), b = vector_at<1>(own_record);
            bits = reached_cells<kPixels>(a.x - corner_x, a.y - corner_y, a.z, a.w, b.x, b.y);
        }
        bits = transpose_bits(bits);
        if (!alive) bits = 0;
        // Load the next index early, to hide the latency. After the last record, the
        // loaded value is not used.
        int highest = 31 - __clz(static_cast<int>(bits));
        uint32_t next = listed_at(last_of_group + kEach * highest);
        while (bits != 0) {
            // Read the record as vectors. If the code copied it to a Record first, nvcc
            // would round the falloff differently in the two variants (one or two
            // pixels) and in the backward pass.
            const float4 a = vector_at<0>(next), b = vector_at<1>(next);
            const float2 c = rest_at(next);
            bits = low_bits(bits, highest);
            highest = 31 - __clz(static_cast<int>(bits));
            next = listed_at(last_of_group + kEach * highest);
            alive = false;
#pragma unroll
            for (int k = 0; k < kPixels; ++k) {
                const Falloff<float> f = falloff_at(p.x[k], p.y, a.x, a.y, a.z, a.w, b.x, b.y);
                const bool goes_on = blend_live(f, p.transmittance[k], stop, [&](float weight) {
                    p.color[0][k] += weight * b.z;
                    p.color[1][k] += weight * b.w;
                    p.color[2][k] += weight * c.x;
                    if (kWithDepth) p.depth[k] += weight * c.y;
                });
                if (kPixels > 1 && !goes_on) p.x[k] = kNowhere;
                alive |= goes_on;
            }
            if (!alive) bits = 0;
        }
        // With StopsBefore, a stopped pixel keeps a transmittance above the threshold.
        // `alive` may then be true although both pixels of the lane have stopped, so
        // test their positions.
        if (kPixels > 1) alive = p.x[0] != kNowhere || p.x[kPixels - 1] != kNowhere;
        __syncwarp();
    }
    for (int k = 0; k < kPixels; ++k)
        if (kPixels > 1 ? p.x[k] == kNowhere : !alive)
            p.transmittance[k] = -fabsf(p.transmittance[k]);
    store(p.transmittance, pixels.transmittance + place);
    for (int c = 0; c < 3; ++c) store(p.color[c], pixels.color[c] + place);
    if (kWithDepth) store(p.depth, s.depth + place);
    publish_alive<kPixels>(alive, sub, s);
}

// Blends the batch over the sub-tiles that contain any of the blocks in `reached`. All
// threads of the block must call it.
template <int kPixels, bool kWithDepth, class Stop, class Shared>
__device__ void blend_batch(uint32_t reached, int left, int top, Shared& s) {
    const uint32_t subs = subs_of<kPixels>(reached), lane = threadIdx.x % 32;
    // Each lane represents a sub-tile, and counts the reached sub-tiles before it. The
    // sub-tile's bit in `subs` is the lane's index.
    const uint32_t before = subs >> lane & 1 ? __popc(subs & ((1u << lane) - 1)) : ~0u;
    // Warp w starts with the w-th sub-tile. A warp that is done claims the next one.
    uint32_t taken = threadIdx.x / 32;
    for (;;) {
        const uint32_t bit = __ballot_sync(kAllLanes, before == taken);
        if (bit == 0) break;
        const unsigned block = __ffs(bit) - 1;
        blend_sub<kPixels, kWithDepth, Stop>(block / SubTile<kPixels>::kBlocks, left, top, s);
        if (threadIdx.x % 32 == 0) taken = Shared::kWarps + atomicAdd(&s.subs_taken, 1u);
        taken = __shfl_sync(kAllLanes, taken, 0);
    }
}

}  // namespace cuda
}  // namespace v3dg

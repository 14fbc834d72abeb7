#pragma once

// Collects the pages that a cut needs on the device, and reports them to the host.

#include "select/cut_parts.cuh"

namespace v3dg {
namespace cuda {

// Records the page that an instance needs because of cluster c.
__device__ inline void tell_need(const InstanceCut<AskedGroups>& cut, int32_t c, uint32_t bundle,
                                 const NeedList& needs) {
    if (cut.table.pages.is_whole()) return;
    const PageNeed need = page_need(cut.table, c, [&](int32_t g) {
        return priority_of(wanted_metric_px2(cut.table, g, cut.view, cut.rule), cut.rule);
    });
    if (need.page < 0 || cut.is_culled(c)) return;
    uint32_t* word = needs.need[bundle] + need.page;
    // Bits of positive floats have the same order as the floats.
    const uint32_t bits = __float_as_uint(need.priority);
    if (*static_cast<volatile uint32_t*>(word) >= bits || atomicMax(word, bits) != 0) return;
    const unsigned place = atomicAdd(needs.words, 1u);
    if (place < needs.capacity)
        needs.list[place] = {
            .bundle = bundle, .page = static_cast<uint32_t>(need.page), .priority = 0.0f};
}

// Writes the list of needed pages to host memory, with one thread per page. A warp
// writes consecutive words, because scattered writes to host memory are slow.
__device__ inline void report_needs(const NeedList& needs, const SelectRule& rule,
                                    const CutChoice* choice) {
    constexpr unsigned kWords = sizeof(PageRequest) / sizeof(uint32_t);
    __shared__ uint32_t words[kWords * kCutThreads];
    const unsigned num_pages = *needs.words, count = min(num_pages, needs.capacity);
    if (blockIdx.x == 0 && threadIdx.x == 0)
        *needs.report = {
            .count = num_pages,
            .tolerance_px2 = rule.budget == kNoBudget ? rule.tolerance_px2 : choice->tolerance_px2};
    for (unsigned first = blockIdx.x * kCutThreads; first < count;
         first += gridDim.x * kCutThreads) {
        const unsigned here = min(count - first, kCutThreads);
        if (threadIdx.x < here) {
            const PageRequest need = needs.list[first + threadIdx.x];
            uint32_t* own = words + kWords * threadIdx.x;
            own[0] = need.bundle;
            own[1] = need.page;
            own[2] = needs.need[need.bundle][need.page];
        }
        __syncthreads();
        auto* reported = reinterpret_cast<uint32_t*>(needs.reported + first);
        for (unsigned i = threadIdx.x; i < kWords * here; i += kCutThreads) reported[i] = words[i];
        __syncthreads();
    }
}

}  // namespace cuda
}  // namespace v3dg

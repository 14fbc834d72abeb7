#pragma once

// What selection reads of a bundle.

#include <cstdint>
#include <vector>

#include "base/span.h"
#include "frame/draw_list.h"
#include "math/bounds.h"
#include "residency/page_table.h"

namespace v3dg {

// G groups, C clusters. Group -1 is none.
struct ClusterTable {
    Span<const Ball> ball;     // [G] contains the balls of the groups below it
    Span<const float> weight;  // [G] per px2, never decreasing towards the root
    Span<const int32_t>
        level;  // [G] of the clusters that the group makes, ascending towards the root
    Span<const int32_t> own_group;     // [C] group that made the cluster; -1: always fits
    Span<const int32_t> parent_group;  // [C] group that replaces the cluster; -1: nothing does
    Span<const Box> box;               // [C] what the cluster draws, without the filter
    Span<const int64_t> offset;        // [C + 1] how many gaussians the clusters before each have
    Span<const int32_t> top_group;     // groups that no other group replaces
    Span<const int32_t> top_cluster;   // clusters that no group replaces
    Box bounds;                        // of all boxes
    float pad_px;                      // how far the filter reaches, and a pixel
    PageTable pages;                   // where the gaussians are

    V3DG_HD size_t num_clusters() const { return own_group.size; }
    V3DG_HD int64_t num_gaussians(size_t c) const { return offset[c + 1] - offset[c]; }
    V3DG_HD size_t num_pages() const { return ball.size + 1; }
    V3DG_HD size_t page_of(size_t c) const {
        return parent_group[c] < 0 ? ball.size : parent_group[c];
    }
    // Where the rows of a cluster begin among those that are resident; its page is.
    V3DG_HD int64_t first_row(size_t c) const {
        return pages.is_whole() ? offset[c] : offset[c] + pages.shift[page_of(c)];
    }
    // Which of the clusters that are resident it is.
    V3DG_HD uint32_t place_of(size_t c) const {
        const auto place = static_cast<uint32_t>(c);
        return pages.cluster_shift.empty() ? place : place + pages.cluster_shift[page_of(c)];
    }
    // Whether they begin where those of the cluster before it end, wherever pages lie.
    V3DG_HD bool follows(size_t c) const {
        return pages.is_whole() || page_of(c) == page_of(c - 1);
    }
};

// Low-pass of a level 0 that has none of its own, in a cut that fades: that of coarser levels by
// default.
constexpr float kFadeFilterPx2 = 0.05f;

// How the clusters of a bundle are drawn.
struct ClusterAppearance {
    Span<const float> filter_px2;     // [C]
    Span<const uint8_t> antialiased;  // [C]

    V3DG_HD Appearance<float> operator[](size_t c) const {
        return {filter_px2[c], antialiased[c] != 0, false};
    }
    // In a cut that fades, where the gaussians of level 0, too, are not to come and go between the
    // samples.
    V3DG_HD Appearance<float> faded(const ClusterTable& table, size_t c) const {
        if (table.own_group[c] >= 0 || filter_px2[c] > 0.0f) return (*this)[c];
        return {kFadeFilterPx2, true, true};
    }
};

// The tables of a bundle on the host. Borrows the arrays that it is given and owns what it derives
// from them.
class HostTable {
  public:
    // `given` has the arrays from `ball` to `offset`, and the pages.
    HostTable(const ClusterTable& given, const ClusterAppearance& appearance);
    HostTable(const HostTable&) = delete;
    HostTable& operator=(const HostTable&) = delete;

    const ClusterTable& table() const { return table_; }
    const ClusterAppearance& appearance() const { return appearance_; }

  private:
    void find_tops();

    std::vector<int32_t> top_group_, top_cluster_;
    ClusterTable table_;
    ClusterAppearance appearance_;
};

}  // namespace v3dg

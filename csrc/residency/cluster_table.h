#pragma once

// The tables of a bundle that selection reads: its groups, its clusters, and the
// locations of their pages.

#include <cstdint>
#include <vector>

#include "base/span.h"
#include "frame/draw_list.h"
#include "math/bounds.h"
#include "residency/page_table.h"

namespace v3dg {

// The tables of a bundle with G groups and C clusters. The group -1 means no group.
struct ClusterTable {
    Span<const Ball> ball;     // [G] contains the balls of the groups below
    Span<const float> weight;  // [G] 1 / gaussians; never decreases towards the root
    // [G] level of the clusters that the group makes, in ascending order
    Span<const int32_t> level;
    // [C] group that made the cluster; -1 for a leaf
    Span<const int32_t> own_group;
    Span<const int32_t> parent_group;  // [C] group that replaces the cluster; -1 if
                                       // none
    Span<const Box> box;               // [C] contains the gaussians of the cluster, as
                                       // drawn without the filter
    Span<const int64_t> offset;        // [C + 1] number of gaussians before each cluster
    Span<const int32_t> top_group;     // groups that no other group replaces
    Span<const int32_t> top_cluster;   // clusters that no group replaces
    Box bounds;                        // contains all boxes
    float pad_px;                      // reach of the filter, plus a pixel
    PageTable pages;                   // locations of the gaussians

    V3DG_HD size_t num_clusters() const { return own_group.size; }
    V3DG_HD int64_t num_gaussians(size_t c) const { return offset[c + 1] - offset[c]; }
    V3DG_HD size_t num_pages() const { return ball.size + 1; }
    V3DG_HD size_t page_of(size_t c) const {
        return parent_group[c] < 0 ? ball.size : parent_group[c];
    }
    // Returns the first row of a cluster in memory. Precondition: the cluster's page is
    // resident.
    V3DG_HD int64_t first_row(size_t c) const {
        return pages.is_whole() ? offset[c] : offset[c] + pages.shift[page_of(c)];
    }
    // Returns the index of a cluster among the clusters in memory. Precondition: the
    // cluster's page is resident.
    V3DG_HD uint32_t place_of(size_t c) const {
        const auto place = static_cast<uint32_t>(c);
        return pages.cluster_shift.empty() ? place : place + pages.cluster_shift[page_of(c)];
    }
    // Returns whether the rows of a cluster always follow those of the cluster before
    // it, wherever their pages are in memory.
    V3DG_HD bool follows(size_t c) const {
        return pages.is_whole() || page_of(c) == page_of(c - 1);
    }
};

// The filter, px², of level 0 in a cut with a fade, if level 0 has no filter of its
// own. It equals the default filter of coarser levels.
constexpr float kFadeFilterPx2 = 0.05f;

// The filter of each cluster, and whether the cluster was trained with antialiasing.
struct ClusterAppearance {
    Span<const float> filter_px2;     // [C]
    Span<const uint8_t> antialiased;  // [C]

    V3DG_HD Appearance<float> operator[](size_t c) const {
        return {filter_px2[c], antialiased[c] != 0, false};
    }
    // Returns the appearance of a cluster in a cut with a fade. In such a cut, level 0
    // always has a filter. Without it, gaussians smaller than a pixel could appear and
    // vanish between pixel centres.
    V3DG_HD Appearance<float> faded(const ClusterTable& table, size_t c) const {
        if (table.own_group[c] >= 0 || filter_px2[c] > 0.0f) return (*this)[c];
        return {kFadeFilterPx2, true, true};
    }
};

// The tables of a bundle on the host. It points to the arrays that are passed to the
// constructor, and owns those that it computes from them.
class HostTable {
  public:
    // `table` must have all arrays from `ball` to `offset`, and the pages.
    HostTable(const ClusterTable& table, const ClusterAppearance& appearance);
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

#pragma once

#include <vector>

#include "bindings/types.h"

namespace v3dg {

// The tables of one bundle on the host, with the arrays that they borrow from.
class BoundTable {
  public:
    BoundTable(py::array ball, py::array weight, py::array level, py::array own_group, py::array parent_group,
               py::array box, py::array filter_px2, py::array antialiased, py::array offset);
    BoundTable(const BoundTable&) = delete;

    const ClusterTable& table() const { return table_; }
    Span<const float> filter_px2() const { return filter_px2_; }
    Span<const uint8_t> antialiased() const { return antialiased_; }
    size_t num_gaussians() const { return static_cast<size_t>(table_.offset[table_.offset.size - 1]); }

  private:
    void find_top();
    void find_bounds();

    std::vector<py::array> arrays_;
    std::vector<int32_t> top_group_, top_cluster_;
    ClusterTable table_;
    Span<const float> filter_px2_;
    Span<const uint8_t> antialiased_;
};

// The pairs (instance, cluster) of a selection, and what it came to.
struct BoundCut {
    py::array_t<int32_t> instance_ids, cluster_ids;
    int64_t num_gaussians;
    float tolerance_px2;
    bool fits_budget;

    explicit BoundCut(const SelectOutput& out);
};

}  // namespace v3dg

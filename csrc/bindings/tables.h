#pragma once

// The tables of bundles, and cuts, for Python.

#include <map>
#include <memory>
#include <vector>

#include "bindings/types.h"
#include "residency/cluster_table.h"

namespace v3dg {

namespace backend { class Tables; }

// The tables of one bundle, and the arrays that they borrow from.
class BoundTable {
  public:
    BoundTable(py::array ball, py::array weight, py::array level, py::array own_group,
               py::array parent_group, py::array box, py::array filter_px2, py::array antialiased,
               py::array offset, py::object page_shift, py::object page_begins);
    BoundTable(const BoundTable&) = delete;

    const ClusterTable& table() const { return host_->table(); }
    const ClusterAppearance& appearance() const { return host_->appearance(); }
    size_t num_gaussians() const {
        return static_cast<size_t>(table().offset[table().offset.size - 1]);
    }

    // Returns the memory in bytes of the tables on a device.
    size_t bytes_on(int device) const;

    // Returns the tables on a device. All scenes on the device share them. They are
    // created if no scene has them yet.
    std::shared_ptr<const backend::Tables> on(const Work& work) const;

  private:
    std::vector<py::array> arrays_;
    std::unique_ptr<HostTable> host_;
    mutable std::map<int, std::weak_ptr<const backend::Tables>> on_device_;
};

// A selected cut for Python: pairs (instance, cluster), and the results of the budget.
struct BoundCut {
    py::array_t<int32_t> instance_ids, cluster_ids;
    py::array_t<float> weights;
    int64_t num_gaussians;
    float tolerance_px2;
    bool fits_budget;

    explicit BoundCut(const SelectOutput& out);
};

}  // namespace v3dg

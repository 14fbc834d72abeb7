#pragma once

#include <memory>

#include "bindings/types.h"
#include "quantize/quantize.h"

namespace v3dg {

inline void check_sh_degree(int sh_degree) {
    if (sh_degree < 0 || sh_degree > kMaxShDegree)
        throw py::value_error("sh_degree: expected 0 to 3, got " + std::to_string(sh_degree));
}

// Returns the values of an array. They must not decrease, and must be from 0 to
// `count`.
inline Span<const int64_t> boundaries_of(const py::array& array, const char* name, size_t count) {
    const Span<const int64_t> values = span_of<const int64_t>(array, name, {-1});
    bool good =
        values.size > 0 && values[0] >= 0 && values[values.size - 1] <= static_cast<int64_t>(count);
    for (size_t i = 1; good && i < values.size; ++i) good = values[i - 1] <= values[i];
    if (!good)
        throw py::value_error(std::string(name) + ": expected ascending boundaries from 0 to " +
                              std::to_string(count) + ", got other numbers");
    return values;
}

// All coded pages of a bundle, and the arrays that they borrow from.
class BoundCodes {
  public:
    BoundCodes(py::array pages, py::array first_cluster, py::array offset, int sh_degree)
        : arrays_{std::move(pages), std::move(first_cluster), std::move(offset)} {
        check_sh_degree(sh_degree);
        const Span<const int32_t> words = span_of<const int32_t>(arrays_[0], "pages", {-1});
        // The indices of rows, and of 8-byte units of codes, have 32 bits.
        constexpr size_t kMostWords = size_t(1) << 33;
        if (words.size > kMostWords)
            throw py::value_error(
                "pages: expected at most 32 GiB, got more; build several bundles");
        const size_t most = words.size / kRecordWords;
        const auto clusters = boundaries_of(arrays_[2], "offset", most);
        const auto pages_of = boundaries_of(arrays_[1], "first_cluster", clusters.size - 1);
        size_t num_bytes = 0;
        for (size_t p = 0; p + 1 < pages_of.size; ++p)
            num_bytes +=
                page_bytes(static_cast<size_t>(clusters[pages_of[p + 1]] - clusters[pages_of[p]]),
                           static_cast<size_t>(pages_of[p + 1] - pages_of[p]), sh_degree);
        if (clusters[0] != 0 || pages_of[0] != 0 ||
            pages_of[pages_of.size - 1] != static_cast<int64_t>(clusters.size - 1) ||
            num_bytes != 4 * words.size)
            throw py::value_error("pages: expected " + std::to_string(num_bytes) +
                                  " bytes of all clusters in order, got " +
                                  std::to_string(4 * words.size));
        const Unlocked unlocked;
        pages_ = std::make_unique<CodedPages>(reinterpret_cast<const uint32_t*>(words.data),
                                              pages_of, clusters, sh_degree);
    }

    const CodedPages& pages() const { return *pages_; }
    size_t num_gaussians() const {
        const Span<const int64_t> offset = pages_->codes().offset;
        return static_cast<size_t>(offset[offset.size - 1]);
    }

  private:
    py::array arrays_[3];
    std::unique_ptr<CodedPages> pages_;
};

}  // namespace v3dg

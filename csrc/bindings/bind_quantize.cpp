#include "bindings/operations.h"
#include "bindings/types.h"
#include "quantize/quantize.h"

namespace v3dg {

namespace {

py::tuple page_code_bytes(int sh_degree) {
    if (sh_degree < 0 || sh_degree > 3)
        throw py::value_error("sh_degree: expected 0 to 3, got " + std::to_string(sh_degree));
    return py::make_tuple(4 * (kRecordWords + num_sh_words(sh_degree)), cluster_code_bytes(sh_degree),
                          kPageAlignment);
}

// Boundaries of a page's clusters among so many rows.
Span<const int64_t> clusters_of(const py::array& offset, size_t num_rows) {
    const Span<const int64_t> values = span_of<const int64_t>(offset, "offset", {-1});
    bool good =
        values.size > 0 && values[0] >= 0 && values[values.size - 1] <= static_cast<int64_t>(num_rows);
    for (size_t i = 1; good && i < values.size; ++i) good = values[i - 1] <= values[i];
    if (!good)
        throw py::value_error("offset: expected ascending boundaries from 0 to " + std::to_string(num_rows) +
                              ", got others");
    return values;
}

py::ssize_t num_words(Span<const int64_t> offset, int sh_degree) {
    const auto num_gaussians = static_cast<size_t>(offset[offset.size - 1] - offset[0]);
    return static_cast<py::ssize_t>(page_bytes(num_gaussians, offset.size - 1, sh_degree) / 4);
}

py::object encode_rows(const Rows& gaussians, const py::array& offset) {
    const GaussianRows<const float> in = gaussians.read<float>();
    if (!gaussians.device().is_host())
        throw py::value_error("gaussians: expected arrays on the host, got others; bring them there");
    const Span<const int64_t> clusters = clusters_of(offset, in.size);
    const NewArray<int32_t> page({}, {num_words(clusters, in.sh_degree)});
    {
        const py::gil_scoped_release unlocked;
        cpu::encode_page(in, {clusters, reinterpret_cast<uint32_t*>(page.span.data), in.sh_degree});
    }
    return page.object;
}

void decode_rows(const py::object& page, const py::array& offset, const Rows& out) {
    const GaussianRows<float> rows = out.write();
    const Span<const int64_t> clusters = clusters_of(offset, rows.size);
    const auto words =
        span_on<const int32_t>(out.device(), page, "page", {num_words(clusters, rows.sh_degree)});
    const Work work(out.device());
    const py::gil_scoped_release unlocked;
    const PageCodes<const uint32_t> codes{clusters, reinterpret_cast<const uint32_t*>(words.data),
                                          rows.sh_degree};
    V3DG_DISPATCH(work, decode_page, codes, rows);
}

}  // namespace

void bind_quantize(py::module_& m) {
    m.def("page_code_bytes", &page_code_bytes, "sh_degree"_a,
          "Bytes of a gaussian and of a cluster in a page of codes, and what pages are filled up to.");
    m.def("encode_page", &encode_rows, "gaussians"_a, "offset"_a,
          "Words (W,) int32 of a page: the gaussians from offset[0] on as codes relative to the ranges of "
          "their "
          "clusters, which begin at `offset` (K+1,).");
    m.def("decode_page", &decode_rows, "page"_a, "offset"_a, "out"_a,
          "Writes the gaussians of a page of codes to rows from offset[0] on; on a device, where ranges are "
          "not "
          "checked, too.");
}

}  // namespace v3dg

#include "bindings/codes.h"
#include "bindings/operations.h"

namespace v3dg {

namespace {

py::tuple page_code_bytes(int sh_degree) {
    check_sh_degree(sh_degree);
    return py::make_tuple(4 * (kRecordWords + num_sh_words(sh_degree)), cluster_code_bytes(sh_degree),
                          kPageAlignment);
}

py::ssize_t num_words(Span<const int64_t> offset, int sh_degree) {
    const auto num_gaussians = static_cast<size_t>(offset[offset.size - 1] - offset[0]);
    return static_cast<py::ssize_t>(page_bytes(num_gaussians, offset.size - 1, sh_degree) / 4);
}

py::object encode_rows(const Rows& gaussians, const py::array& offset) {
    const GaussianRows<const float> in = gaussians.read<float>();
    if (!gaussians.device().is_host())
        throw py::value_error("gaussians: expected arrays on the host, got others; bring them there");
    const Span<const int64_t> clusters = boundaries_of(offset, "offset", in.size);
    const NewArray<int32_t> page({}, {num_words(clusters, in.sh_degree)});
    {
        const py::gil_scoped_release unlocked;
        cpu::encode_page(in, {clusters, reinterpret_cast<uint32_t*>(page.span.data), in.sh_degree});
    }
    return page.object;
}

void decode_rows(const py::array& page, const py::array& offset, const Rows& out) {
    const GaussianRows<float> rows = out.write();
    if (!out.device().is_host())
        throw py::value_error("out: expected arrays on the host, got others; bring them there");
    const Span<const int64_t> clusters = boundaries_of(offset, "offset", rows.size);
    const auto words = span_of<const int32_t>(page, "page", {num_words(clusters, rows.sh_degree)});
    const py::gil_scoped_release unlocked;
    cpu::decode_page({clusters, reinterpret_cast<const uint32_t*>(words.data), rows.sh_degree}, rows);
}

}  // namespace

void bind_quantize(py::module_& m) {
    m.def("page_code_bytes", &page_code_bytes, "sh_degree"_a,
          "Bytes of a gaussian and of a cluster in a page of codes, and what pages are filled up to.");
    m.def("encode_page", &encode_rows, "gaussians"_a, "offset"_a,
          "Words (W,) int32 of a page: the gaussians from offset[0] on as codes relative to the ranges of "
          "their clusters, which begin at `offset` (K+1,).");
    m.def("decode_page", &decode_rows, "page"_a, "offset"_a, "out"_a,
          "Writes the gaussians of a page of codes to rows from offset[0] on.");
    py::class_<BoundCodes>(m, "Codes", "All pages of a bundle as codes, on the host; borrows the arrays.")
        .def(py::init<py::array, py::array, py::array, int>(), "pages"_a, "first_cluster"_a, "offset"_a,
             "sh_degree"_a);
}

}  // namespace v3dg

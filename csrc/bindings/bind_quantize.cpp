#include "bindings/backend.h"
#include "bindings/operations.h"
#include "quantize/codebook.h"

namespace v3dg {

namespace {

py::tuple page_code_bytes(int sh_degree) {
    check_sh_degree(sh_degree);
    return py::make_tuple(4 * (kRecordWords + num_sh_words(sh_degree)),
                          cluster_code_bytes(sh_degree), kPageAlignment);
}

py::ssize_t num_words(Span<const int64_t> offset, int sh_degree) {
    const auto num_gaussians = static_cast<size_t>(offset[offset.size - 1] - offset[0]);
    return static_cast<py::ssize_t>(page_bytes(num_gaussians, offset.size - 1, sh_degree) / 4);
}

py::object encode_rows(const Rows& gaussians, const py::array& offset) {
    const GaussianRows<const float> in = gaussians.read<float>();
    check_is_on_host(gaussians.device(), "gaussians",
                     "expected arrays on the host, got arrays on a device; copy them to the host");
    const Span<const int64_t> clusters = boundaries_of(offset, "offset", in.size);
    const NewArray<int32_t> page({}, {num_words(clusters, in.sh_degree)});
    {
        const Unlocked unlocked;
        cpu::encode_page(in, {clusters, reinterpret_cast<uint32_t*>(page.span.data), in.sh_degree});
    }
    return page.object;
}

void decode_rows(const py::array& page, const py::array& offset, const Rows& out) {
    const GaussianRows<float> rows = out.write();
    check_is_on_host(out.device(), "out",
                     "expected arrays on the host, got arrays on a device; copy them to the host");
    const Span<const int64_t> clusters = boundaries_of(offset, "offset", rows.size);
    const auto words = span_of<const int32_t>(page, "page", {num_words(clusters, rows.sh_degree)});
    const Unlocked unlocked;
    cpu::decode_page({clusters, reinterpret_cast<const uint32_t*>(words.data), rows.sh_degree},
                     rows);
}

py::object codebook_of(const py::array& values) {
    const auto in = span_of<const double>(values, "values", {-1});
    const NewArray<double> table({}, {static_cast<py::ssize_t>(kCodebookSize)});
    {
        const Unlocked unlocked;
        make_codebook(in, table.span);
    }
    return table.object;
}

py::tuple palette_of(const py::array& vectors, size_t size) {
    const auto in = span_of<const float>(vectors, "vectors", {-1, -1});
    const auto width = static_cast<size_t>(vectors.shape(1));
    VectorPalette palette;
    {
        const Unlocked unlocked;
        palette = make_palette(in, width, size);
    }
    const py::ssize_t count = width ? palette.vectors.size() / width : 1;
    return py::make_tuple(py::array_t<double>({count, vectors.shape(1)}, palette.vectors.data()),
                          py::array_t<uint32_t>(static_cast<py::ssize_t>(palette.labels.size()),
                                                palette.labels.data()));
}

}  // namespace

void bind_quantize(py::module_& m) {
    m.def("page_code_bytes", &page_code_bytes, "sh_degree"_a,
          "Returns the bytes per gaussian and per cluster in a coded page, and the alignment of "
          "pages.");
    m.def("encode_page", &encode_rows, "gaussians"_a, "offset"_a,
          "Encodes gaussians offset[0] to offset[K] as a page. Cluster k begins at offset[k]. "
          "Returns the page as (W,) int32.");
    m.def("decode_page", &decode_rows, "page"_a, "offset"_a, "out"_a,
          "Decodes the gaussians of a coded page to the rows from offset[0] on.");
    m.def("codebook_of", &codebook_of, "values"_a,
          "Returns 256 ascending numbers that represent the values (N,), by Lloyd's algorithm. "
          "They are exact if there are at most 256 different values.");
    m.def("palette_of", &palette_of, "vectors"_a, "size"_a,
          "Returns a palette of at most `size` vectors (K, D) that represent the vectors (N, D),"
          " and the label of each vector (N,).");
    py::class_<BoundCodes>(m, "Codes",
                           "All coded pages of a bundle, on the host. It borrows the arrays.")
        .def(py::init<py::array, py::array, py::array, int>(), "pages"_a, "first_cluster"_a,
             "offset"_a, "sh_degree"_a);
}

}  // namespace v3dg

#include <cerrno>
#include <system_error>

#include "bindings/codes.h"
#include "bindings/operations.h"
#include "io/hashed_read.h"
#include "residency/page_run.h"

namespace v3dg {

namespace {

PageRun run_of(const py::array& hashes, size_t first_page, const py::array& first_cluster,
               const py::array& offset, const py::array& places) {
    constexpr size_t kMost = size_t(1) << 62;
    PageRun run{
        first_page, {}, boundaries_of(offset, "offset", kMost), boundaries_of(places, "places", kMost), {}};
    run.first_cluster = boundaries_of(first_cluster, "first_cluster", run.offset.size - 1);
    if (run.first_cluster.size != run.places.size)
        throw py::value_error("places: expected " + std::to_string(run.first_cluster.size) + ", got " +
                              std::to_string(run.places.size));
    run.hashes = span_of<const uint8_t>(hashes, "hashes", {static_cast<py::ssize_t>(run.size()), 16});
    return run;
}

// Calls body() without the interpreter lock; what goes wrong with a page gets the file's name, which need not
// be text that can be encoded.
template <class Body>
void naming_file(const py::object& path, const Body& body) {
    try {
        const py::gil_scoped_release unlocked;
        body();
    } catch (const PageError& error) {
        if (error.is_damage)
            PyErr_SetObject(PyExc_ValueError, py::str("{}: {}").format(path, error.what()).ptr());
        else
            PyErr_SetObject(PyExc_OSError, py::make_tuple(error.code, error.what(), path).ptr());
        throw py::error_already_set();
    } catch (const std::system_error& error) {
        errno = error.code().value();
        PyErr_SetFromErrnoWithFilenameObject(PyExc_OSError, path.ptr());
        throw py::error_already_set();
    }
}

void read_rows(const py::object& path, int descriptor, const PageRun& run, PageCodec codec, const Rows& out) {
    const GaussianRows<float> rows = out.write();
    const auto count = static_cast<size_t>(run.offset[run.offset.size - 1] - run.offset[0]);
    if (!out.device().is_host() || rows.size != count)
        throw py::value_error("out: expected " + std::to_string(count) +
                              " gaussians on the host, got others");
    const bool is_quantized = codec == PageCodec::quantized;
    for (size_t page = 0; page < run.size(); ++page) {
        const Span<const int64_t> clusters = run.clusters(page);
        const auto size = static_cast<size_t>(clusters[clusters.size - 1] - clusters[0]);
        const size_t needed = is_quantized ? page_bytes(size, clusters.size - 1, rows.sh_degree)
                                           : sizeof(float) * (11 + rows.num_sh()) * size;
        if (run.num_bytes(page) < needed)
            throw py::value_error("places: expected " + std::to_string(needed) + " bytes of a page, got " +
                                  std::to_string(run.num_bytes(page)));
    }
    naming_file(path, [&] {
        const PosixFile file = PosixFile::duplicate(descriptor);
        read_pages(file, run, codec, rows);
    });
}

void read_words(const py::object& path, int descriptor, const PageRun& run, const py::array& out) {
    const int64_t num_bytes = run.places[run.size()] - run.places[0];
    if (num_bytes % 4 != 0)
        throw py::value_error("places: expected whole words, got " + std::to_string(num_bytes) + " bytes");
    const Span<int32_t> words = span_of<int32_t>(out, "out", {static_cast<py::ssize_t>(num_bytes / 4)});
    naming_file(path, [&] { read_codes(PosixFile::duplicate(descriptor), run, words); });
}

// `out` is rows, which are decoded, or an array of words, which are not.
void read_run(const py::object& path, int descriptor, const py::object& out, const std::string& codec,
              const py::array& hashes, size_t first_page, const py::array& first_cluster,
              const py::array& offset, const py::array& places) {
    const PageRun run = run_of(hashes, first_page, first_cluster, offset, places);
    if (py::isinstance<py::array>(out)) return read_words(path, descriptor, run, out.cast<py::array>());
    const PageCodec of = codec == "quantized" ? PageCodec::quantized : PageCodec::float32;
    read_rows(path, descriptor, run, of, held<Rows>(out, "out"));
}

std::vector<py::bytes> hash_messages(const std::vector<py::array>& arrays) {
    std::vector<Span<const uint8_t>> messages;
    for (const py::array& array : arrays) messages.push_back(span_of<const uint8_t>(array, "messages", {-1}));
    std::vector<PageHash> hashes(messages.size());
    {
        const py::gil_scoped_release unlocked;
        blake2b({messages.data(), messages.size()}, hashes.data());
    }
    std::vector<py::bytes> digests;
    for (const PageHash& hash : hashes)
        digests.emplace_back(reinterpret_cast<const char*>(hash.data()), hash.size());
    return digests;
}

// With the arrays that it reads to and hashes.
class BoundHashedRead {
  public:
    BoundHashedRead(py::object path, int descriptor, const py::array& before, size_t offset,
                    const py::array& out)
        : path_(std::move(path)), arrays_(py::make_tuple(before, out)) {
        const Span<const uint8_t> first = span_of<const uint8_t>(before, "before", {-1});
        const Span<uint8_t> bytes = span_of<uint8_t>(out, "out", {-1});
        naming_file(path_, [&] {
            read_ = std::make_unique<HashedRead>(PosixFile::duplicate(descriptor), first, offset, bytes);
        });
    }
    bool wait() {
        bool is_whole = false;
        naming_file(path_, [&] { is_whole = read_->wait(); });
        return is_whole;
    }
    py::bytes digest() {
        PageHash digest{};
        {
            const py::gil_scoped_release unlocked;
            digest = read_->digest();
        }
        return {reinterpret_cast<const char*>(digest.data()), digest.size()};
    }

  private:
    const py::object path_;
    const py::tuple arrays_;
    std::unique_ptr<HashedRead> read_;
};

}  // namespace

void bind_pages(py::module_& m) {
    py::class_<BoundHashedRead>(m, "HashedRead", "A part of a file that is read and hashed at the same time.")
        .def(py::init<py::object, int, py::array, size_t, py::array>(), "path"_a, "descriptor"_a, "before"_a,
             "offset"_a, "out"_a)
        .def("wait", &BoundHashedRead::wait, "Waits until out is filled; whether the file has so much.")
        .def("digest", &BoundHashedRead::digest,
             "BLAKE2b-128 of what is in before and out together, once they are filled.");
    m.def("blake2b", &hash_messages, "messages"_a, "BLAKE2b-128 of several messages, side by side.");
    m.attr("DAMAGED") = kDamaged;
    m.def(
        "read_pages", &read_run, "path"_a, "descriptor"_a, "out"_a, "codec"_a, "hashes"_a, py::kw_only(),
        "first_page"_a, "first_cluster"_a, "offset"_a, "places"_a,
        "Fills rows with the gaussians of neighbouring pages of a file, which have these hashes (n, 16), or "
        "an array of words (W,) int32 with what the pages are as they are.");
}

}  // namespace v3dg

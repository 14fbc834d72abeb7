// Bindings that read, verify and hash the pages of files.

#include <algorithm>
#include <cerrno>
#include <memory>
#include <optional>
#include <string_view>
#include <system_error>
#include <utility>

#include "bindings/backend.h"
#include "bindings/codes.h"
#include "bindings/operations.h"
#include "io/hashed_read.h"
#include "residency/page_run.h"

namespace v3dg {

namespace {

// A range of adjacent pages of a file, and the arrays with their locations.
struct BoundPageRun {
    size_t first_page;
    py::array first_cluster, offset, places;

    // Borrows the arrays. `hashes` has one hash per page.
    PageRun read(const py::array& hashes) const {
        constexpr size_t kMost = size_t(1) << 62;
        PageRun run{.first_page = first_page,
                    .first_cluster = {},
                    .offset = boundaries_of(offset, "offset", kMost),
                    .places = boundaries_of(places, "places", kMost),
                    .hashes = {}};
        run.first_cluster = boundaries_of(first_cluster, "first_cluster", run.offset.size - 1);
        if (run.first_cluster.size != run.places.size)
            throw py::value_error("places: expected " + std::to_string(run.first_cluster.size) +
                                  " numbers, got " + std::to_string(run.places.size));
        run.hashes =
            span_of<const uint8_t>(hashes, "hashes", {static_cast<py::ssize_t>(run.size()), 16});
        return run;
    }
};

// Calls body() without the GIL. If it throws a PageError, adds the name of the file,
// which need not be valid UTF-8.
template <class Body>
void naming_file(const py::object& path, const Body& body) {
    try {
        const Unlocked unlocked;
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

// Throws ValueError unless the gaussians are on the host and have the size of the run,
// and the run's pages have enough bytes for them.
void check_rows(const PageRun& run, PageCodec codec, const Rows& gaussians, const char* name) {
    const auto count = static_cast<size_t>(run.offset[run.offset.size - 1] - run.offset[0]);
    check_is_on_host(gaussians.device(), name,
                     "expected arrays on the host, got arrays on a device");
    if (gaussians.size() != count)
        refuse_value(name, "expected " + std::to_string(count) + " gaussians, got " +
                               std::to_string(gaussians.size()));
    const int sh_degree = gaussians.sh_degree();
    const size_t gaussian_bytes = sizeof(float) * (11 + 3 * num_sh_bases(sh_degree));
    for (size_t page = 0; page < run.size(); ++page) {
        const Span<const int64_t> clusters = run.clusters(page);
        const auto size = static_cast<size_t>(clusters[clusters.size - 1] - clusters[0]);
        const size_t needed = codec == PageCodec::quantized
                                  ? page_bytes(size, clusters.size - 1, sh_degree)
                                  : gaussian_bytes * size;
        if (run.num_bytes(page) < needed)
            throw py::value_error("places: expected at least " + std::to_string(needed) +
                                  " bytes for a page, got " + std::to_string(run.num_bytes(page)));
    }
}

PageCodec page_codec_of(const std::string& name) {
    return name == "quantized" ? PageCodec::quantized : PageCodec::float32;
}

void read_rows(const py::object& path, int descriptor, const PageRun& run, PageCodec codec,
               const Rows& out) {
    const GaussianRows<float> rows = out.write();
    check_rows(run, codec, out, "out");
    naming_file(path, [&] {
        const File file = File::duplicate(descriptor);
        read_pages(file, run, codec, rows);
    });
}

void read_words(const py::object& path, int descriptor, const PageRun& run, const py::array& out) {
    const int64_t num_bytes = run.places[run.size()] - run.places[0];
    if (num_bytes % 4 != 0)
        throw py::value_error("places: expected pages of a multiple of 4 bytes, got " +
                              std::to_string(num_bytes));
    const Span<int32_t> words =
        span_of<int32_t>(out, "out", {static_cast<py::ssize_t>(num_bytes / 4)});
    naming_file(path, [&] { read_codes(File::duplicate(descriptor), run, words); });
}

// Reads a range of pages to `out`. If `out` is Rows, it receives decoded gaussians. If
// it is an array of integers, it receives the codes.
void read_run(const py::object& path, int descriptor, const py::object& out,
              const std::string& codec, const py::array& hashes, const BoundPageRun& bound) {
    const PageRun run = bound.read(hashes);
    if (py::isinstance<py::array>(out))
        return read_words(path, descriptor, run, out.cast<py::array>());
    read_rows(path, descriptor, run, page_codec_of(codec), held<Rows>(out, "out"));
}

// Writes a range of pages, and returns (n, 16) their hashes. `path` is used in errors.
py::object write_run(const py::object& path, int descriptor, const Rows& gaussians,
                     const std::string& codec, const BoundPageRun& bound) {
    const auto num_pages = static_cast<py::ssize_t>(bound.places.size() - 1);
    const NewArray<uint8_t> hashes({}, {num_pages, static_cast<py::ssize_t>(kPageHashBytes)});
    const PageRun run = bound.read(hashes.object);
    check_rows(run, page_codec_of(codec), gaussians, "gaussians");
    const GaussianRows<const float> rows = gaussians.read<float>();
    naming_file(path, [&] {
        write_pages(File::duplicate(descriptor), run, page_codec_of(codec), rows, hashes.span.data);
    });
    return hashes.object;
}

std::vector<py::bytes> hash_messages(const std::vector<py::array>& arrays) {
    std::vector<Span<const uint8_t>> messages;
    for (const py::array& array : arrays)
        messages.push_back(span_of<const uint8_t>(array, "messages", {-1}));
    std::vector<PageHash> hashes(messages.size());
    {
        const Unlocked unlocked;
        blake2b({messages.data(), messages.size()}, hashes.data());
    }
    std::vector<py::bytes> digests;
    for (const PageHash& hash : hashes)
        digests.emplace_back(reinterpret_cast<const char*>(hash.data()), hash.size());
    return digests;
}

// A read in progress, and the array that receives the bytes.
class BoundHashedRead {
  public:
    BoundHashedRead(const py::object& path, int descriptor, size_t offset,
                    py::array_t<uint8_t> message, size_t num_before, HashOf how)
        : path_(path), message_(std::move(message)), offset_(offset), num_before_(num_before) {
        const Span<uint8_t> bytes = span_of<uint8_t>(message_, "message", {-1});
        naming_file(path_, [&] {
            read_.emplace(File::duplicate(descriptor), offset, bytes, num_before, how);
        });
    }
    py::array wait();
    bool is_sound();

  private:
    const py::object path_;
    const py::array_t<uint8_t> message_;
    const size_t offset_, num_before_;
    std::optional<HashedRead> read_;
};

// Reads parts of several files. Small parts share blocks of memory that are large
// enough for huge pages.
class BoundReader {
  public:
    std::unique_ptr<BoundHashedRead> read(const py::object& path, int descriptor,
                                          const py::bytes& before, size_t offset, size_t num_bytes,
                                          bool in_pieces) {
        const auto first = before.cast<std::string_view>();
        if (num_bytes < kPageHashBytes)
            throw py::value_error("num_bytes: expected at least 16, got " +
                                  std::to_string(num_bytes));
        py::array_t<uint8_t> message = take(first.size() + num_bytes);
        std::copy(first.begin(), first.end(), message.mutable_data());
        return std::make_unique<BoundHashedRead>(path, descriptor, offset, std::move(message),
                                                 first.size(),
                                                 in_pieces ? HashOf::pieces : HashOf::bytes);
    }

  private:
    // Returns memory that is aligned to 8 bytes.
    py::array_t<uint8_t> take(size_t num_bytes) {
        const size_t size = (num_bytes + 7) / 8 * 8;
        if (size > left_) {
            // The first small part gets its own memory, so that reading a single small
            // part does not allocate a whole block.
            const bool is_small = size < HashedRead::kLargeBytes && piece_.size() > 0;
            left_ = is_small ? size * kFilesOfPiece : size;
            piece_ = py::array_t<uint64_t>(static_cast<py::ssize_t>(left_ / 8));
        }
        const auto* first = static_cast<const uint8_t*>(piece_.data()) + piece_.nbytes() - left_;
        left_ -= size;
        return py::array_t<uint8_t>(static_cast<py::ssize_t>(num_bytes), first, piece_);
    }

    static constexpr size_t kFilesOfPiece = 8;
    py::array piece_;
    size_t left_ = 0;  // unused bytes of the block
};

py::array BoundHashedRead::wait() {
    naming_file(path_, [&] {
        if (!read_->wait())
            throw PageError("size: expected bytes at " + std::to_string(offset_) +
                                ", got the end of the file; it was truncated",
                            true);
    });
    py::array bytes = message_[py::slice(num_before_, message_.size(), 1)];
    bytes.attr("flags").attr("writeable") = false;
    return bytes;
}

bool BoundHashedRead::is_sound() {
    const Unlocked unlocked;
    return read_->is_sound();
}

}  // namespace

void bind_pages(py::module_& m) {
    py::class_<BoundHashedRead>(m, "HashedRead",
                                "A part of a file that is read and hashed at the same time.")
        .def("wait", &BoundHashedRead::wait,
             "Waits until all bytes are read, and returns them. Raises ValueError if the file is"
             " shorter.")
        .def("is_sound", &BoundHashedRead::is_sound,
             "Waits until all bytes are hashed. Returns whether the bytes end with their hash.");
    py::class_<BoundReader>(m, "HashedReader",
                            "Reads and hashes parts of several files. Small parts share blocks "
                            "of memory.")
        .def(py::init<>())
        .def("read", &BoundReader::read, "path"_a, "descriptor"_a, "before"_a, "offset"_a,
             "num_bytes"_a, "in_pieces"_a,
             "Starts to read bytes of a file that end with a BLAKE2b-128 hash. The hash is of "
             "`before` followed by the bytes, or of the hashes of their pieces. The bytes are "
             "aligned to 8 if the size of `before` is a multiple of 8.");
    m.def("blake2b", &hash_messages, "messages"_a,
          "Returns the BLAKE2b-128 hashes of several messages, computed in parallel.");
    m.attr("DAMAGED") = kDamaged;
    m.attr("HASH_PIECE_BYTES") = kHashPieceBytes;
    py::class_<BoundPageRun>(m, "PageRun",
                             "A range of adjacent pages of a file. It borrows the "
                             "arrays.")
        .def(py::init([](size_t first_page, const py::array& first_cluster, const py::array& offset,
                         const py::array& places) {
                 return BoundPageRun{.first_page = first_page,
                                     .first_cluster = first_cluster,
                                     .offset = offset,
                                     .places = places};
             }),
             py::kw_only(), "first_page"_a, "first_cluster"_a, "offset"_a, "places"_a);
    m.def("write_pages", &write_run, "path"_a, "descriptor"_a, "gaussians"_a, "codec"_a, "run"_a,
          "Encodes and writes a range of pages, and returns (n, 16) their hashes.");
    m.def("read_pages", &read_run, "path"_a, "descriptor"_a, "out"_a, "codec"_a, "hashes"_a,
          "run"_a,
          "Reads and verifies a range of pages; `hashes` is (n, 16). Decodes the gaussians to "
          "rows, or copies the pages unchanged to an array (W,) int32.");
}

}  // namespace v3dg

#pragma once

// The source of the bytes of a bundle's pages: a file, which may have to be fetched first, or
// memory; and the codecs that pages have (PageCodec). Any thread may read from it.
// docs/extending.md says how to add a codec.

#include <cstdint>
#include <functional>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/span.h"
#include "io/posix_file.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

namespace v3dg {

// A page that cannot be read; what() names the file and the page.
class PageError : public std::runtime_error {
  public:
    PageError(const std::string& text, bool is_damage, int code = 0)
        : std::runtime_error(text), is_damage(is_damage), code(code) {}
    const bool is_damage;  // the content of the file is wrong; else the system failed to read it
    const int code;        // errno of the system, or 0
};

constexpr const char* kDamaged = "the file is damaged, copy or build it again";

// A page to be read, and the error if that failed.
struct PageReading {
    size_t page;
    unsigned char* bytes;  // has room for the whole page
    std::optional<PageError> error;
};
// Most pages that are read together; a constant, so that reading allocates nothing.
constexpr size_t kMostPagesTogether = 64;

// Reads at most kMostPagesTogether pages of a file, in ascending order, and verifies their hashes,
// several at once. Neighbours are read in one call, including small gaps between them. `places` is
// [P + 1], the first byte of each page and the end; `hashes` is [P][16]. Errors begin with
// name_of(page).
void read_verified(const PosixFile& file, Span<const int64_t> places, const uint8_t* hashes,
                   Span<PageReading> pages, const std::function<std::string(size_t)>& name_of);

enum class PageCodec { float32, quantized };

// The pages of a bundle, as bytes.
class PageSource {
  public:
    PageSource(const ClusterTable& table, int sh_degree, PageCodec codec);
    virtual ~PageSource() = default;
    int sh_degree() const { return sh_degree_; }
    PageCodec codec() const { return codec_; }
    size_t num_pages() const { return first_cluster_.size() - 1; }
    size_t num_clusters() const { return offset_.size() - 1; }
    size_t num_clusters(size_t page) const {
        return first_cluster_[page + 1] - first_cluster_[page];
    }
    size_t first_cluster(size_t page) const { return first_cluster_[page]; }
    // [K + 1] the first row of each cluster of a page, among the rows of the bundle, and the end.
    Span<const int64_t> clusters(size_t page) const;
    int64_t first_row(size_t page) const { return offset_[first_cluster_[page]]; }
    size_t num_rows(size_t page) const {
        return offset_[first_cluster_[page + 1]] - first_row(page);
    }

    // The bytes of a page, including padding.
    virtual size_t num_bytes(size_t page) const = 0;
    // Reads at most kMostPagesTogether pages, in ascending order, and verifies them. Fastest for
    // neighbours.
    virtual void read_pages(Span<PageReading> pages) const = 0;
    // Reads and verifies one page. Throws PageError.
    void read(size_t page, unsigned char* bytes) const;
    // Whether reading is so slow that a page should not be read before it is missed.
    virtual bool is_far() const { return false; }
    // Tells the source that these pages will be read soon.
    virtual void expect(Span<const PageReading> pages) const { static_cast<void>(pages); }

    // The rows of a page, given its bytes: borrowed from them, or from `decoded`.
    GaussianRows<const float> rows(size_t page, const unsigned char* bytes,
                                   std::vector<float>& decoded) const;

  private:
    const int sh_degree_;
    const PageCodec codec_;
    std::vector<size_t> first_cluster_;  // [P + 1]
    std::vector<int64_t> offset_;        // [C + 1]
};

// Fetches parts of a file before they are read: for each pair of numbers, the bytes from the first
// to the second. Returns the problem, or an empty text. Called on any thread.
using Fetch = std::function<std::string(Span<const int64_t>)>;

// Pages of a file, which stays open as long as this lives. The file may be renamed or removed in
// the meantime; if it is truncated or written to, the hashes show it.
class FilePages : public PageSource {
  public:
    // `place` is [P + 1], `hash` is [P][16], as docs/format.md describes them. `fetch` is empty if
    // the whole file is there.
    FilePages(const ClusterTable& table, int sh_degree, PageCodec codec, std::string name,
              int descriptor, Span<const int64_t> place, Span<const uint8_t> hash, Fetch fetch);
    size_t num_bytes(size_t page) const override { return place_[page + 1] - place_[page]; }
    void read_pages(Span<PageReading> pages) const override;
    void expect(Span<const PageReading> pages) const override;
    bool is_far() const override { return fetch_ != nullptr; }

  private:
    std::string name_of(size_t page) const { return name_ + ": page " + std::to_string(page); }
    bool fetch(Span<PageReading> pages) const;

    const std::string name_;
    const PosixFile file_;
    const std::vector<int64_t> place_;
    const std::vector<uint8_t> hash_;
    const Fetch fetch_;
};

// Pages of gaussians in memory, which have to outlive this.
class MemoryPages : public PageSource {
  public:
    MemoryPages(const ClusterTable& table, const GaussianRows<const float>& rows)
        : PageSource(table, rows.sh_degree, PageCodec::float32), rows_(rows) {}
    size_t num_bytes(size_t page) const override;
    void read_pages(Span<PageReading> pages) const override;

  private:
    void copy(size_t page, unsigned char* bytes) const;

    const GaussianRows<const float> rows_;
};

// The rows of a page of float32 gaussians, borrowed from its bytes.
GaussianRows<const float> rows_of_page(const unsigned char* bytes, size_t num_gaussians,
                                       int sh_degree);

}  // namespace v3dg

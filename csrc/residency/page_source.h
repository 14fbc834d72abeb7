#pragma once

// The sources of a bundle's pages: a file, which may have to be fetched first, or
// memory. Also the codecs of pages (PageCodec); docs/extending.md describes how to add
// one. Any thread may read from a source.

#include <cstdint>
#include <functional>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/span.h"
#include "io/file.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

namespace v3dg {

// The error for a page that cannot be read. what() names the file and the page.
class PageError : public std::runtime_error {
  public:
    PageError(const std::string& text, bool is_damage, int code = 0)
        : std::runtime_error(text), is_damage(is_damage), code(code) {}
    // True if the content of the file is wrong; false if the system failed to read it.
    const bool is_damage;
    const int code;  // errno of the system call, or 0
};

constexpr const char* kDamaged = "the file is damaged, copy or build it again";

// A page to read, the memory to read it into, and the error if reading fails.
struct PageReading {
    size_t page;
    unsigned char* bytes;  // must have room for the whole page
    std::optional<PageError> error;
};
// Maximum number of pages that are read together. It is a constant, so that reading
// need not allocate memory.
constexpr size_t kMostPagesTogether = 64;

// Reads at most kMostPagesTogether pages of a file, in ascending order. Adjacent pages,
// and pages with small gaps between them, are read in one system call. The hashes of
// several pages are verified at once. `places` is [P + 1], the offset of each page and
// the end; `hashes` is [P][16]. Error texts begin with name_of(page).
void read_verified(const File& file, Span<const int64_t> places, const uint8_t* hashes,
                   Span<PageReading> pages, const std::function<std::string(size_t)>& name_of);

enum class PageCodec { float32, quantized };

// A source of the pages of a bundle, as bytes.
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
    // Returns the first row of each cluster of a page, then the end: [K + 1] indices in
    // the bundle.
    Span<const int64_t> clusters(size_t page) const;
    int64_t first_row(size_t page) const { return offset_[first_cluster_[page]]; }
    size_t num_rows(size_t page) const {
        return offset_[first_cluster_[page + 1]] - first_row(page);
    }

    // Returns the bytes of a page, including padding.
    virtual size_t num_bytes(size_t page) const = 0;
    // Reads and verifies at most kMostPagesTogether pages, in ascending order. Adjacent
    // pages are read fastest.
    virtual void read_pages(Span<PageReading> pages) const = 0;
    // Reads and verifies one page. Throws PageError.
    void read(size_t page, unsigned char* bytes) const;
    // Returns whether the source is so slow that pages should not be read ahead of use.
    virtual bool is_far() const { return false; }
    // Announces that these pages will be read soon.
    virtual void expect(Span<const PageReading> pages) const { static_cast<void>(pages); }

    // Converts the bytes of a page to rows. The rows point into `bytes` or `decoded`.
    GaussianRows<const float> rows(size_t page, const unsigned char* bytes,
                                   std::vector<float>& decoded) const;

  private:
    const int sh_degree_;
    const PageCodec codec_;
    std::vector<size_t> first_cluster_;  // [P + 1]
    std::vector<int64_t> offset_;        // [C + 1]
};

// A function that fetches parts of a file before they are read. Its argument has two
// numbers per part, the first byte and the end. It returns an error text, or an empty
// string on success. Any thread may call it.
using Fetch = std::function<std::string(Span<const int64_t>)>;

// The pages of a file, which stays open while this object exists. Meanwhile, the file
// may be renamed or removed. If it is truncated or overwritten, the hashes detect this.
class FilePages : public PageSource {
  public:
    // `place` is [P + 1] and `hash` is [P][16] (docs/format.md). `fetch` is empty if
    // the whole file is local.
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
    const File file_;
    const std::vector<int64_t> place_;
    const std::vector<uint8_t> hash_;
    const Fetch fetch_;
};

// Pages of gaussians in memory. The gaussians must outlive this object.
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

// Returns the rows of a page of float32 gaussians. They point into `bytes`.
GaussianRows<const float> rows_of_page(const unsigned char* bytes, size_t num_gaussians,
                                       int sh_degree);

}  // namespace v3dg

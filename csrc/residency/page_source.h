#pragma once

// Where the bytes of a bundle's pages come from: a file, or memory. Read on any thread.

#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/span.h"
#include "io/posix_file.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

namespace v3dg {

// A page that cannot be had; what() names the file and the page.
class PageError : public std::runtime_error {
  public:
    PageError(const std::string& text, bool is_damage, int code = 0)
        : std::runtime_error(text), is_damage(is_damage), code(code) {}
    const bool is_damage;  // of what is in the file; else the system failed to read it
    const int code;        // the system's
};

constexpr const char* kDamaged = "the file is damaged, copy or build it again";

// Reads all bytes of a page and compares their hash, [16]. Throws PageError, which begins with `where`.
void read_verified(const PosixFile& file, size_t place, size_t size, const uint8_t* hash,
                   const std::string& where, unsigned char* bytes);

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
    size_t num_clusters(size_t page) const { return first_cluster_[page + 1] - first_cluster_[page]; }
    size_t first_cluster(size_t page) const { return first_cluster_[page]; }
    // [K + 1] where the clusters of a page begin among the rows of the bundle, and the end.
    Span<const int64_t> clusters(size_t page) const;
    int64_t first_row(size_t page) const { return offset_[first_cluster_[page]]; }
    size_t num_rows(size_t page) const { return offset_[first_cluster_[page + 1]] - first_row(page); }

    // With what it is filled up with.
    virtual size_t num_bytes(size_t page) const = 0;
    // Writes all bytes of a page, verified. Throws PageError.
    virtual void read(size_t page, unsigned char* bytes) const = 0;
    // A run of pages will be read soon.
    virtual void expect(size_t first_page, size_t num_pages) const {
        static_cast<void>(first_page), static_cast<void>(num_pages);
    }

    // The rows of a page, given its bytes: borrowed from them, or from `decoded`.
    GaussianRows<const float> rows(size_t page, const unsigned char* bytes,
                                   std::vector<float>& decoded) const;

  private:
    const int sh_degree_;
    const PageCodec codec_;
    std::vector<size_t> first_cluster_;  // [P + 1]
    std::vector<int64_t> offset_;        // [C + 1]
};

// Pages of a file that stays open as long as this lives; one that is renamed or removed meanwhile stays
// readable, one that is cut or written to is found out.
class FilePages : public PageSource {
  public:
    // `place` is [P + 1], `hash` is [P][16], as docs/format.md has them.
    FilePages(const ClusterTable& table, int sh_degree, PageCodec codec, std::string name, int descriptor,
              Span<const int64_t> place, Span<const uint8_t> hash);
    size_t num_bytes(size_t page) const override { return place_[page + 1] - place_[page]; }
    void read(size_t page, unsigned char* bytes) const override;
    void expect(size_t first_page, size_t num_pages) const override {
        file_.expect(place_[first_page], place_[first_page + num_pages] - place_[first_page]);
    }

  private:
    const std::string name_;
    const PosixFile file_;
    const std::vector<int64_t> place_;
    const std::vector<uint8_t> hash_;
};

// Pages of gaussians in memory, which outlive this.
class MemoryPages : public PageSource {
  public:
    MemoryPages(const ClusterTable& table, const GaussianRows<const float>& rows)
        : PageSource(table, rows.sh_degree, PageCodec::float32), rows_(rows) {}
    size_t num_bytes(size_t page) const override;
    void read(size_t page, unsigned char* bytes) const override;

  private:
    const GaussianRows<const float> rows_;
};

// The rows of a page of so many gaussians in float32, borrowed from its bytes.
GaussianRows<const float> rows_of_page(const unsigned char* bytes, size_t num_gaussians, int sh_degree);

}  // namespace v3dg

#pragma once

// A bundle whose file is open. Its tables are in memory, and its pages in the file.

#include <memory>
#include <string>
#include <vector>

#include "base/buffer.h"
#include "c_interface/bundle_header.h"
#include "residency/cluster_table.h"
#include "residency/page_source.h"

namespace v3dg {

// The object never changes, so any number of threads may use it.
class OpenBundle {
  public:
    // Opens a file, and reads and checks its header, its tables, and their hash. Throws
    // Fault.
    explicit OpenBundle(const std::string& path);
    OpenBundle(const OpenBundle&) = delete;

    const BundleHeader& header() const { return header_; }
    const ClusterTable& table() const { return host_->table(); }
    const ClusterAppearance& appearance() const { return host_->appearance(); }
    const PageSource& pages() const { return *pages_; }
    size_t num_pages() const { return header_.num_pages; }
    size_t num_levels() const;
    int32_t level_of_cluster(size_t cluster) const { return level_[cluster]; }
    // Returns the group above, which replaces the clusters that `group` makes, or -1.
    int32_t parent_of_group(size_t group) const { return parent_[group]; }
    // Returns the offset of a page's first byte in the file. If `page` is the number of
    // pages, this is the end of the last page.
    int64_t place(size_t page) const { return places_[page]; }

  private:
    class File;

    template <class T>
    Span<const T> column(const std::string& name) const;
    void check_all(const std::string& path, File& file);
    void check_tables(const std::string& path) const;
    void check_page_tables(const std::string& path) const;
    void check_page_table(const std::string& path, const std::string& name,
                          const std::vector<int64_t>& expected) const;
    void make_pages(const std::string& path, const File& file);

    BundleHeader header_;
    Buffer<uint64_t> message_;  // the header and the tables, followed by their hash
    std::unique_ptr<HostTable> host_;
    std::unique_ptr<PageSource> pages_;
    Span<const int32_t> level_, parent_;
    std::vector<int64_t> places_;
};

}  // namespace v3dg

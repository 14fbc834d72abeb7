// Opens bundles with the checks of the Python reader (v3dg/bundle/bundle.py), in the
// same order: the structure of the file, the tables, and then their hash. If both a
// table and the hash are wrong, the error about the hash is reported, because most
// wrong tables are damaged files.

#include "c_interface/bundle.h"

#include <algorithm>
#include <cerrno>
#include <limits>
#include <optional>
#include <system_error>

#include <fcntl.h>
#include <unistd.h>

#include "c_interface/fault.h"
#include "cluster/check_tables.h"
#include "io/hashed_read.h"

namespace v3dg {

namespace {

template <class T>
std::string shown(T value) {
    if constexpr (std::is_floating_point_v<T>)
        return text_of(static_cast<double>(value));
    else
        return std::to_string(value);
}

// Returns `width` values of a row of a table, formatted as in Python. Row -1 is the
// last row.
template <class T>
std::string row_text(Span<const T> values, int64_t row, size_t width) {
    const size_t number = row < 0 ? values.size / width - 1 : static_cast<size_t>(row);
    if (width == 1) return shown(values[number]);
    std::string text;
    for (size_t k = 0; k < width; ++k)
        text += (k > 0 ? ", " : "") + shown(values[number * width + k]);
    return "[" + text + "]";
}

}  // namespace

// The open file. It is closed with this object. Readers duplicate its descriptor.
class OpenBundle::File {
  public:
    explicit File(const std::string& path)
        : descriptor_(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK)) {
        if (descriptor_ < 0)
            throw Fault(V3DG_ERROR_SYSTEM, path + ": " + std::generic_category().message(errno));
    }
    File(const File&) = delete;
    ~File() { ::close(descriptor_); }
    int descriptor() const { return descriptor_; }
    v3dg::File duplicate() const { return v3dg::File::duplicate(descriptor_); }

    std::optional<HashedRead> tables;

  private:
    const int descriptor_;
};

OpenBundle::OpenBundle(const std::string& path) {
    File file(path);
    const auto fail = [&](const std::string& problem) {
        throw Fault(V3DG_ERROR_FILE, path + ": " + problem);
    };
    const v3dg::File reader = file.duplicate();
    if (!reader.is_regular()) fail("expected a file, got a directory, a device or a pipe");
    const uint64_t num_bytes = reader.size();
    if (num_bytes < 8)
        fail("expected a bundle, got a file of only " + std::to_string(num_bytes) + " bytes");
    if (num_bytes >= kMostFileBytes) fail("size: expected less than 2^48 bytes, got more");
    uint64_t header_bytes = 0;  // all numbers in files are little endian
    if (reader.read_at(0, reinterpret_cast<char*>(&header_bytes), 8) != 8)
        fail("size: expected more bytes, got the end of the file; it was truncated");
    if (header_bytes == 0)
        fail("expected a bundle, got an unfinished one or another kind of file; build it again");
    if (header_bytes > std::min(num_bytes - 8, kMostHeaderBytes))
        fail("header: expected a bundle (safetensors), got a header length of " +
             std::to_string(header_bytes) + " in a file of " + std::to_string(num_bytes) +
             " bytes; the file is truncated or no bundle, see v3dg.open");
    std::string text(8 + header_bytes, '\0');
    if (reader.read_at(0, text.data(), text.size()) != text.size())
        fail("size: expected more bytes, got the end of the file; it was truncated");
    header_ = read_bundle_header(path, std::string_view(text).substr(8), text.size(), num_bytes);
    const uint64_t first_table = header_.data_start + header_.pages_bytes();
    const size_t message_bytes = text.size() + (num_bytes - first_table);
    auto* bytes = reinterpret_cast<uint8_t*>(message_.reserve(message_bytes / 8 + 1));
    std::copy(text.begin(), text.end(), bytes);
    const HashOf hash_of = header_.version > 2 ? HashOf::pieces : HashOf::bytes;
    file.tables.emplace(file.duplicate(), first_table, Span<uint8_t>{bytes, message_bytes},
                        text.size(), hash_of);
    if (!file.tables->wait())
        fail("size: expected bytes at " + std::to_string(first_table) +
             ", got the end of the file; it was truncated");
    check_all(path, file);
    make_pages(path, file);
}

template <class T>
Span<const T> OpenBundle::column(const std::string& name) const {
    const FilePart& part = header_.parts.at(name);
    // The tables follow the header in the message.
    const auto* bytes = reinterpret_cast<const unsigned char*>(message_.data()) +
                        header_.data_start + (part.first - header_.pages_bytes());
    return {reinterpret_cast<const T*>(bytes), (part.end - part.first) / sizeof(T)};
}

void OpenBundle::check_all(const std::string& path, File& file) {
    const auto check_hash = [&] {
        if (!file.tables->is_sound())
            throw Fault(V3DG_ERROR_FILE,
                        path + ": hash: does not match the header and the tables; " + kDamaged);
    };
    try {
        check_tables(path);
        check_page_tables(path);
    } catch (const Fault&) {
        check_hash();
        throw;
    }
    check_hash();
}

void OpenBundle::check_tables(const std::string& path) const {
    const auto check = [&](bool holds, const std::string& expected) {
        if (!holds) throw Fault(V3DG_ERROR_FILE, path + ": " + expected);
    };
    const auto offset = column<int64_t>("clusters.offset");
    const int64_t num_gaussians = offset[header_.num_clusters];
    const auto most = static_cast<int64_t>(header_.pages_bytes() / header_.gaussian_bytes());
    check(num_gaussians <= most, "clusters.offset[-1]: expected at most " + std::to_string(most) +
                                     " gaussians, got " + std::to_string(num_gaussians));
    check(
        header_.num_clusters <= size_t(std::numeric_limits<int32_t>::max()),
        "clusters: expected fewer than 2^31 clusters, got " + std::to_string(header_.num_clusters));
    const auto box = column<float>("clusters.box");
    const auto ball = column<float>("groups.ball");
    const GivenTables tables{.offset = offset,
                             .level = column<int32_t>("clusters.level"),
                             .own_group = column<int32_t>("clusters.own_group"),
                             .parent_group = column<int32_t>("clusters.parent_group"),
                             .box = {reinterpret_cast<const Box*>(box.data), header_.num_clusters},
                             .filter_px2 = column<float>("clusters.filter_px2"),
                             .antialiased = column<uint8_t>("clusters.antialiased"),
                             .ball = {reinterpret_cast<const Ball*>(ball.data), header_.num_groups},
                             .weight = column<float>("groups.weight"),
                             .parent = column<int32_t>("groups.parent"),
                             .group_level = column<int32_t>("groups.level"),
                             .error = column<float>("groups.error")};
    try {
        v3dg::check_tables(tables, num_gaussians);
    } catch (const TableFault& fault) {
        std::string value = std::to_string(fault.row);
        if (fault.table == "clusters.offset") value = row_text(offset, fault.row, 1);
        if (fault.table == "clusters.box")  // two corners
            value = "[" + row_text(box, 2 * fault.row, 3) + ", " +
                    row_text(box, 2 * fault.row + 1, 3) + "]";
        if (fault.table == "groups.ball") value = row_text(ball, fault.row, 4);
        if (fault.table == "groups.error") value = row_text(tables.error, fault.row, 2);
        if (fault.table == "clusters.antialiased")
            value = row_text(tables.antialiased, fault.row, 1);
        for (const char* name : {"clusters.filter_px2", "groups.weight"})
            if (fault.table == name) value = row_text(column<float>(name), fault.row, 1);
        for (const char* name : {"clusters.level", "clusters.own_group", "clusters.parent_group",
                                 "groups.parent", "groups.level"})
            if (fault.table == name) value = row_text(column<int32_t>(name), fault.row, 1);
        check(false, fault.table + "[" + std::to_string(fault.row) + "]: expected " +
                         fault.expected + ", got " + value);
    }
}

void OpenBundle::check_page_tables(const std::string& path) const {
    const size_t num_pages = header_.num_clusters == 0 ? 0 : header_.num_groups + 1;
    if (header_.num_pages != num_pages)
        throw Fault(V3DG_ERROR_FILE, path + ": pages: expected " + std::to_string(num_pages) +
                                         " pages for the clusters of the file, got " +
                                         std::to_string(header_.num_pages));
    const auto parent = column<int32_t>("clusters.parent_group");
    const auto offset = column<int64_t>("clusters.offset");
    std::vector<int64_t> place, bytes, first_cluster, num_clusters;
    int64_t end = 0;
    for (size_t c = 0; c < header_.num_clusters;) {
        const size_t first = c;
        while (c < header_.num_clusters && parent[c] == parent[first]) ++c;
        const int64_t num_gaussians = offset[c] - offset[first];
        place.push_back(end);
        first_cluster.push_back(static_cast<int64_t>(first));
        num_clusters.push_back(static_cast<int64_t>(c - first));
        bytes.push_back(num_gaussians * static_cast<int64_t>(header_.gaussian_bytes()));
        end += static_cast<int64_t>(header_.page_bytes(num_gaussians, c - first));
    }
    check_page_table(path, "pages.offset", place);
    if (header_.codec == PageCodec::float32) check_page_table(path, "pages.bytes", bytes);
    check_page_table(path, "pages.first_cluster", first_cluster);
    if (header_.codec == PageCodec::float32)
        check_page_table(path, "pages.num_clusters", num_clusters);
    if (static_cast<uint64_t>(end) != header_.pages_bytes())
        throw Fault(V3DG_ERROR_FILE, path + ": pages: expected " + std::to_string(end) +
                                         " bytes for all gaussians, got " +
                                         std::to_string(header_.pages_bytes()));
}

// Compares a table of 32 or 64 bits with the numbers that follow from the clusters.
void OpenBundle::check_page_table(const std::string& path, const std::string& name,
                                  const std::vector<int64_t>& expected) const {
    const FilePart& part = header_.parts.at(name);
    std::vector<int64_t> values;
    if (part.end - part.first == sizeof(int64_t) * expected.size())
        for (const int64_t value : column<int64_t>(name)) values.push_back(value);
    else
        for (const int32_t value : column<int32_t>(name)) values.push_back(value);
    for (size_t p = 0; p < expected.size(); ++p) {
        if (values[p] != expected[p])
            throw Fault(V3DG_ERROR_FILE, path + ": " + name + "[" + std::to_string(p) +
                                             "]: expected " + std::to_string(expected[p]) +
                                             ", which follows from the clusters, got " +
                                             std::to_string(values[p]));
    }
}

void OpenBundle::make_pages(const std::string& path, const File& file) {
    const auto box = column<float>("clusters.box");
    const auto ball = column<float>("groups.ball");
    ClusterTable table{};
    table.ball = {reinterpret_cast<const Ball*>(ball.data), header_.num_groups};
    table.weight = column<float>("groups.weight");
    table.level = column<int32_t>("groups.level");
    table.own_group = column<int32_t>("clusters.own_group");
    table.parent_group = column<int32_t>("clusters.parent_group");
    table.box = {reinterpret_cast<const Box*>(box.data), header_.num_clusters};
    table.offset = column<int64_t>("clusters.offset");
    host_ = std::make_unique<HostTable>(table,
                                        ClusterAppearance{column<float>("clusters.filter_px2"),
                                                          column<uint8_t>("clusters.antialiased")});
    level_ = column<int32_t>("clusters.level");
    parent_ = column<int32_t>("groups.parent");
    const auto data_start = static_cast<int64_t>(header_.data_start);
    for (const int64_t offset : column<int64_t>("pages.offset"))
        places_.push_back(data_start + offset);
    places_.push_back(data_start + static_cast<int64_t>(header_.pages_bytes()));
    pages_ = std::make_unique<FilePages>(this->table(), header_.sh_degree, header_.codec, path,
                                         file.descriptor(),
                                         Span<const int64_t>{places_.data(), places_.size()},
                                         column<uint8_t>("pages.hash"), Fetch());
}

size_t OpenBundle::num_levels() const {
    return level_.empty() ? 0 : static_cast<size_t>(level_[level_.size - 1]) + 1;
}

}  // namespace v3dg

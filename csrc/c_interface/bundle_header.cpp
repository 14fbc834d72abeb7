// Checks the header of a bundle, in the order and with the error texts of the Python
// reader (v3dg/bundle/file.py). Also computes where its tensors are.

#include "c_interface/bundle_header.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <set>
#include <utility>
#include <vector>

#include "c_interface/fault.h"
#include "c_interface/json.h"
#include "io/blake2b.h"
#include "quantize/quantize.h"

namespace v3dg {

namespace {

constexpr int kNewestVersion = 3;
constexpr uint64_t kFloatAlignment = 4096;

enum class Rows { clusters, clusters_and_end, groups, pages };

// A table of the file: its dtype, and the size and the shape of a row.
struct TableKind {
    const char* name;
    const char* dtype;
    uint64_t value_bytes;
    Rows rows;
    std::vector<uint64_t> row_shape;
    bool is_only_of_floats;
};

const std::vector<TableKind>& schema() {
    static const std::vector<TableKind> tables = {
        {"clusters.offset", "I64", 8, Rows::clusters_and_end, {}, false},
        {"pages.offset", "I64", 8, Rows::pages, {}, false},
        {"pages.bytes", "I64", 8, Rows::pages, {}, true},
        {"clusters.level", "I32", 4, Rows::clusters, {}, false},
        {"clusters.own_group", "I32", 4, Rows::clusters, {}, false},
        {"clusters.parent_group", "I32", 4, Rows::clusters, {}, false},
        {"clusters.box", "F32", 4, Rows::clusters, {2, 3}, false},
        {"clusters.filter_px2", "F32", 4, Rows::clusters, {}, false},
        {"groups.ball", "F32", 4, Rows::groups, {4}, false},
        {"groups.weight", "F32", 4, Rows::groups, {}, false},
        {"groups.parent", "I32", 4, Rows::groups, {}, false},
        {"groups.level", "I32", 4, Rows::groups, {}, false},
        {"groups.error", "F32", 4, Rows::groups, {2}, false},
        {"pages.first_cluster", "I32", 4, Rows::pages, {}, false},
        {"pages.num_clusters", "I32", 4, Rows::pages, {}, true},
        {"clusters.antialiased", "U8", 1, Rows::clusters, {}, false},
        {"pages.hash", "U8", 1, Rows::pages, {16}, false},
    };
    return tables;
}

class HeaderReader {
  public:
    HeaderReader(const std::string& path, uint64_t num_bytes)
        : path_(path), num_bytes_(num_bytes) {}

    BundleHeader read(std::string_view text, uint64_t data_start) {
        const Json root = object("header", text);
        out_.data_start = data_start;
        read_metadata(root.find("__metadata__"));
        read_counts(root);
        check_entry(root, "pages", "U8", 1, {pages_bytes_});
        for (const TableKind& table : schema()) check_table(root, table);
        check_entry(root, "hash", "U8", 1, {kPageHashBytes});
        check_no_others(root);
        check_size();
        return out_;
    }

  private:
    [[noreturn]] void fail(const std::string& problem) const {
        throw Fault(V3DG_ERROR_FILE, path_ + ": " + problem);
    }
    void check(bool holds, const std::string& name, const std::string& expected) const {
        if (!holds) fail(name + ": expected " + expected);
    }

    Json object(const std::string& name, std::string_view text) const {
        Json value;
        try {
            value = parse_json(text);
        } catch (const std::invalid_argument& error) {
            fail(name + ": expected JSON, got " + error.what());
        }
        check(value.get<Json::Object>() != nullptr, name, "a JSON object, got " + json_text(value));
        return value;
    }

    void read_metadata(const Json* metadata) {
        const auto value = [&](const char* key) {
            return metadata == nullptr ? nullptr : metadata->find(key);
        };
        const auto text = [&](const char* key) {
            const Json* member = value(key);
            return member == nullptr ? nullptr : member->get<std::string>();
        };
        const std::string* format = text("format");
        check(format != nullptr && *format == "v3dg", "format",
              "'v3dg', got " + json_text(value("format")) + "; the file is not a bundle");
        read_version(text("version"), value("version"));
        const std::string* degree = text("sh_degree");
        const bool is_degree =
            degree != nullptr && degree->size() == 1 && (*degree)[0] >= '0' && (*degree)[0] <= '3';
        check(is_degree, "sh_degree", "'0' to '3', got " + json_text(value("sh_degree")));
        out_.sh_degree = (*degree)[0] - '0';
        read_codec(text("codec"), value("codec"));
        const std::string* config = text("config");
        check(config != nullptr, "config", "JSON in a string, got " + json_text(value("config")));
        const Json settings = object("config", *config);
        const Json* up = settings.find("up");
        if (up != nullptr && up->get<std::string>() != nullptr) out_.up = *up->get<std::string>();
    }

    void read_version(const std::string* version, const Json* value) {
        const auto is_digit = [](char c) { return c >= '0' && c <= '9'; };
        const bool is_number = version != nullptr && !version->empty() && version->size() <= 9 &&
                               std::all_of(version->begin(), version->end(), is_digit) &&
                               version->front() != '0';
        check(is_number, "version", "an integer of at least 1, got " + json_text(value));
        out_.version = std::stoi(*version);
        check(out_.version <= kNewestVersion, "version",
              "at most " + std::to_string(kNewestVersion) + ", got " + *version + "; update v3dg");
    }

    void read_codec(const std::string* codec, const Json* value) {
        if (out_.version == 1) return;  // which is always float32
        const bool is_float = codec != nullptr && *codec == "float32" && out_.version != 2;
        const bool is_quantized = codec != nullptr && *codec == "quantized";
        check(is_float || is_quantized, "codec",
              "a known codec, got " + json_text(value) + "; update v3dg");
        if (is_quantized) out_.codec = PageCodec::quantized;
    }

    void read_counts(const Json& root) {
        uint64_t counts[4];
        const char* const names[4] = {"clusters.level", "groups.parent", "pages.offset", "pages"};
        for (int k = 0; k < 4; ++k) counts[k] = length_of_vector(root, names[k]);
        const uint64_t largest = *std::max_element(counts, counts + 4);
        check(largest <= num_bytes_, "size",
              "more than " + std::to_string(largest) + " bytes, as the tensors need, got " +
                  std::to_string(num_bytes_) + "; the file is truncated");
        out_.num_clusters = counts[0];
        out_.num_groups = counts[1];
        out_.num_pages = counts[2];
        pages_bytes_ = counts[3];
    }

    uint64_t length_of_vector(const Json& root, const char* name) const {
        const Json* entry = root.find(name);
        const Json* shape = entry == nullptr ? nullptr : entry->find("shape");
        const auto* lengths = shape == nullptr ? nullptr : shape->get<Json::Array>();
        const bool is_vector = lengths != nullptr && lengths->size() == 1;
        const auto* length = is_vector ? lengths->front().get<int64_t>() : nullptr;
        check(length != nullptr && *length >= 0, name,
              "a one-dimensional tensor, got " + json_text(entry));
        return static_cast<uint64_t>(*length);
    }

    uint64_t num_rows(Rows rows) const {
        switch (rows) {
            case Rows::clusters: return out_.num_clusters;
            case Rows::clusters_and_end: return out_.num_clusters + 1;
            case Rows::groups: return out_.num_groups;
            case Rows::pages: break;
        }
        return out_.num_pages;
    }

    void check_table(const Json& root, const TableKind& table) {
        if (table.is_only_of_floats && out_.codec != PageCodec::float32) return;
        std::vector<uint64_t> shape = {num_rows(table.rows)};
        shape.insert(shape.end(), table.row_shape.begin(), table.row_shape.end());
        check_entry(root, table.name, table.dtype, table.value_bytes, shape);
    }

    // Fails unless the header's entry of a tensor is the expected one, which follows
    // from its type and shape and from the tensors before it. Records where the tensor
    // is, so tensors must be checked in the order of the file.
    void check_entry(const Json& root, const std::string& name, const std::string& dtype,
                     uint64_t value_bytes, const std::vector<uint64_t>& shape) {
        uint64_t size = value_bytes;
        for (const uint64_t side : shape) size *= side;
        const FilePart part{end_, end_ + size};
        const Json* entry = root.find(name);
        const auto* members = entry == nullptr ? nullptr : entry->get<Json::Object>();
        const bool is_equal = members != nullptr && members->size() == 3 &&
                              is_text(entry->find("dtype"), dtype) &&
                              are_numbers(entry->find("shape"), shape) &&
                              are_numbers(entry->find("data_offsets"), {part.first, part.end});
        check(is_equal, name,
              "{'dtype': '" + dtype + "', 'shape': " + text_of(shape) + ", 'data_offsets': " +
                  text_of({part.first, part.end}) + "}, got " + json_text(entry));
        out_.parts[name] = part;
        end_ = part.end;
    }

    static bool is_text(const Json* value, const std::string& expected) {
        const auto* text = value == nullptr ? nullptr : value->get<std::string>();
        return text != nullptr && *text == expected;
    }
    static bool are_numbers(const Json* value, const std::vector<uint64_t>& expected) {
        const auto* items = value == nullptr ? nullptr : value->get<Json::Array>();
        if (items == nullptr || items->size() != expected.size()) return false;
        for (size_t k = 0; k < expected.size(); ++k) {
            const auto* number = (*items)[k].get<int64_t>();
            if (number == nullptr || *number < 0) return false;
            if (static_cast<uint64_t>(*number) != expected[k]) return false;
        }
        return true;
    }
    static std::string text_of(const std::vector<uint64_t>& numbers) {
        std::string text;
        for (const uint64_t number : numbers)
            text += (text.empty() ? "" : ", ") + std::to_string(number);
        return "[" + text + "]";
    }

    void check_no_others(const Json& root) const {
        std::set<std::string> unknown;
        for (const Json::Member& member : *root.get<Json::Object>())
            if (out_.parts.count(member.key) == 0 && member.key != "__metadata__")
                unknown.insert(member.key);
        if (unknown.empty()) return;
        fail(in_quotes(*unknown.begin()) + ": expected only tensors of format version " +
             std::to_string(out_.version) + ", got another one");
    }

    void check_size() const {
        const uint64_t alignment = out_.alignment();
        const std::pair<const char*, uint64_t> ends[] = {{"header", out_.data_start},
                                                         {"pages", pages_bytes_}};
        for (const auto& [name, end] : ends)
            check(end % alignment == 0, name,
                  "to end at a multiple of " + std::to_string(alignment) + " bytes, got " +
                      std::to_string(end));
        const uint64_t size = out_.data_start + end_;
        const std::string problem = size > num_bytes_ ? "truncated" : "followed by other data";
        check(size == num_bytes_, "size",
              std::to_string(size) + " bytes, got " + std::to_string(num_bytes_) +
                  "; the file is " + problem);
    }

    const std::string& path_;
    const uint64_t num_bytes_;
    uint64_t pages_bytes_ = 0;
    uint64_t end_ = 0;  // end of the tensors that were compared
    BundleHeader out_;
};

}  // namespace

uint64_t BundleHeader::alignment() const {
    return codec == PageCodec::float32 ? kFloatAlignment : uint64_t(kPageAlignment);
}

uint64_t BundleHeader::gaussian_bytes() const {
    if (codec == PageCodec::float32) return sizeof(float) * (11 + 3 * num_sh_bases(sh_degree));
    return sizeof(uint32_t) * (kRecordWords + num_sh_words(sh_degree));
}

uint64_t BundleHeader::cluster_bytes() const {
    return codec == PageCodec::float32 ? 0 : cluster_code_bytes(sh_degree);
}

uint64_t BundleHeader::page_bytes(uint64_t num_gaussians, uint64_t num_clusters_of_page) const {
    const uint64_t size = num_gaussians * gaussian_bytes() + num_clusters_of_page * cluster_bytes();
    return (size + alignment() - 1) / alignment() * alignment();
}

BundleHeader read_bundle_header(const std::string& path, std::string_view text, uint64_t data_start,
                                uint64_t num_bytes) {
    return HeaderReader(path, num_bytes).read(text, data_start);
}

}  // namespace v3dg

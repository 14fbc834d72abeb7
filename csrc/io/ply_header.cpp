// Parses the header of a .ply file. Callers must compare the sizes in it with the size
// of the file.

#include "io/ply_header.h"

#include <algorithm>
#include <charconv>

namespace v3dg {

namespace {

// Maximum size of a header. Real headers have a few kilobytes.
constexpr size_t kMaxHeaderBytes = size_t(1) << 20;
// Maximum number of elements. Real files have one or two. There is a limit because
// elements before the vertices must be skipped one after another.
constexpr size_t kMaxElements = 64;

constexpr const char* kSpace = " \t\r\v\f";

std::vector<std::string> words_of(const std::string& line) {
    std::vector<std::string> words;
    size_t first = line.find_first_not_of(kSpace);
    while (first != std::string::npos) {
        const size_t last = std::min(line.find_first_of(kSpace, first), line.size());
        words.push_back(line.substr(first, last - first));
        first = line.find_first_not_of(kSpace, last);
    }
    return words;
}

// Returns the part of a line after its first word, without surrounding spaces.
std::string rest_of(const std::string& line) {
    const size_t word = line.find_first_not_of(kSpace);
    const size_t space = line.find_first_of(kSpace, word);
    const size_t first = line.find_first_not_of(kSpace, space);
    if (space == std::string::npos || first == std::string::npos) return {};
    return line.substr(first, line.find_last_not_of(kSpace) + 1 - first);
}

PlyType parse_type(const std::string& name) {
    static const std::pair<const char*, PlyType> kTypes[] = {
        {"char", PlyType::int8},       {"int8", PlyType::int8},       {"uchar", PlyType::uint8},
        {"uint8", PlyType::uint8},     {"short", PlyType::int16},     {"int16", PlyType::int16},
        {"ushort", PlyType::uint16},   {"uint16", PlyType::uint16},   {"int", PlyType::int32},
        {"int32", PlyType::int32},     {"uint", PlyType::uint32},     {"uint32", PlyType::uint32},
        {"float", PlyType::float32},   {"float32", PlyType::float32}, {"double", PlyType::float64},
        {"float64", PlyType::float64}, {"half", PlyType::float16},    {"float16", PlyType::float16},
        {"int64", PlyType::int64},     {"uint64", PlyType::uint64},
    };
    for (const auto& [text, type] : kTypes)
        if (name == text) return type;
    throw PlyError("expected a scalar type such as float, got " + in_quotes(name));
}

PlyEncoding parse_format(const std::vector<std::string>& words) {
    if (words.size() != 3 || words[2] != "1.0")
        throw PlyError("expected a format and the version 1.0, got " +
                       std::to_string(words.size() - 1) + " words" +
                       (words.size() > 2 ? " and version " + in_quotes(words[2]) : ""));
    if (words[1] == "ascii") return PlyEncoding::ascii;
    if (words[1] == "binary_little_endian") return PlyEncoding::binary_little_endian;
    if (words[1] == "binary_big_endian") return PlyEncoding::binary_big_endian;
    throw PlyError("expected format ascii, binary_little_endian or binary_big_endian, got " +
                   in_quotes(words[1]));
}

PlyElement parse_element(const std::vector<std::string>& words) {
    if (words.size() != 3)
        throw PlyError("expected 'element NAME COUNT', got " + std::to_string(words.size()) +
                       " words");
    PlyElement element;
    element.name = words[1];
    const char* end = words[2].data() + words[2].size();
    const auto [stop, error] = std::from_chars(words[2].data(), end, element.count);
    if (error != std::errc() || stop != end)
        throw PlyError("expected a count of element " + in_quotes(words[1]) + ", got " +
                       in_quotes(words[2]));
    return element;
}

PlyProperty parse_property(const std::vector<std::string>& words) {
    PlyProperty property;
    property.is_list = words.size() > 1 && words[1] == "list";
    if (words.size() != (property.is_list ? 5u : 3u))
        throw PlyError(std::string("expected 'property ") +
                       (property.is_list ? "list COUNT_TYPE TYPE NAME'" : "TYPE NAME'") + ", got " +
                       std::to_string(words.size()) + " words");
    property.type = parse_type(words[words.size() - 2]);
    property.name = words.back();
    if (property.is_list) {
        property.count_type = parse_type(words[2]);
        if (property.count_type >= PlyType::float32)
            throw PlyError("expected an integer type for the length of a list, got " +
                           in_quotes(words[2]));
    }
    return property;
}

// Parses the lines of a header, one after another.
struct HeaderParser {
    PlyHeader header;
    bool has_format = false;

    // Parses a line. Returns whether it was the last line of the header.
    bool take(const std::string& line) {
        const std::vector<std::string> words = words_of(line);
        if (words.empty()) return false;
        if (words[0] == "comment" || words[0] == "obj_info") {
            header.comments.push_back(rest_of(line));
            return false;
        }
        if (words[0] == "format") {
            if (has_format) throw PlyError("expected one line 'format', got a second one");
            header.encoding = parse_format(words);
            has_format = true;
        } else if (words[0] == "element") {
            if (header.elements.size() == kMaxElements)
                throw PlyError("expected at most " + std::to_string(kMaxElements) +
                               " elements, got one more");
            header.elements.push_back(parse_element(words));
        } else if (words[0] == "property") {
            if (header.elements.empty())
                throw PlyError("expected an element before the first property, got none");
            header.elements.back().properties.push_back(parse_property(words));
        } else if (words[0] == "end_header") {
            if (!has_format) throw PlyError("expected a line 'format' before end_header, got none");
            return true;
        } else {
            throw PlyError("expected format, element, property or end_header, got " +
                           in_quotes(words[0]));
        }
        return false;
    }
};

}  // namespace

bool PlyElement::has_lists() const {
    return std::any_of(properties.begin(), properties.end(),
                       [](const PlyProperty& p) { return p.is_list; });
}

size_t PlyElement::min_row_bytes() const {
    size_t bytes = 0;
    for (const PlyProperty& property : properties)
        bytes += size_of(property.is_list ? property.count_type : property.type);
    return bytes;
}

std::string in_quotes(const std::string& text) {
    constexpr size_t kMaxLength = 40;
    std::string shown = text.substr(0, kMaxLength);
    for (char& c : shown)
        if (c < ' ' || c > '~') c = '?';
    return "'" + shown + (text.size() > kMaxLength ? "..." : "") + "'";
}

File open_ply_file(const char* path) {
    File file = File::open(path);
    if (file.is_folder()) throw std::system_error(EISDIR, std::generic_category());
    if (!file.is_regular()) throw PlyError("expected a regular file, got a device or a pipe");
    return file;
}

PlyHeader read_ply_header(const File& file) {
    HeaderParser parser;
    std::string text;
    size_t line_begin = 0;
    for (size_t line_number = 1;; ++line_number) {
        size_t line_end = text.find('\n', line_begin);
        bool at_end = false;
        while (line_end == std::string::npos && text.size() < kMaxHeaderBytes && !at_end) {
            const size_t searched = text.size();
            text.resize(std::max<size_t>(8192, 2 * searched));
            text.resize(searched + file.read_at(searched, &text[searched], text.size() - searched));
            at_end = text.size() == searched;
            line_end = text.find('\n', searched);
        }
        const bool is_cut = line_end == std::string::npos && text.size() >= kMaxHeaderBytes;
        if (line_end == std::string::npos) line_end = text.size();
        std::string line = text.substr(line_begin, line_end - line_begin);
        if (!line.empty() && line.back() == '\r') line.pop_back();
        if (line_number == 1 && line != "ply")
            throw PlyError("expected a first line 'ply', got " +
                           (text.empty() ? "an empty file" : in_quotes(line)));
        try {
            if (line_number > 1 && !is_cut && parser.take(line)) {
                parser.header.size = std::min(line_end + 1, text.size());
                return std::move(parser.header);
            }
        } catch (const PlyError& error) {
            throw PlyError("header line " + std::to_string(line_number) + ": " + error.what());
        }
        if (line_end >= text.size())
            throw PlyError("expected end_header within the first " +
                           std::to_string(kMaxHeaderBytes) + " bytes, got none in " +
                           std::to_string(text.size()));
        line_begin = line_end + 1;
    }
}

}  // namespace v3dg

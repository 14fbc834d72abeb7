#pragma once

// JSON values, and a parser of strict JSON.

#include <cstdint>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

namespace v3dg {

// A JSON value. Integers that do not fit into an int64_t are stored as doubles.
class Json {
  public:
    struct Member;
    using Array = std::vector<Json>;
    using Object = std::vector<Member>;  // in the order of the file

    std::variant<std::nullptr_t, bool, int64_t, double, std::string, Array, Object> value;

    template <class T>
    const T* get() const {
        return std::get_if<T>(&value);
    }
    // Returns the member of an object with this key. Returns null if there is none, or
    // if the value is not an object.
    const Json* find(std::string_view key) const;
};

struct Json::Member {
    std::string key;
    Json value;
};

// Parses JSON in UTF-8, with or without a byte order mark. Throws std::invalid_argument
// for anything else, for keys that occur twice in an object, and for deep nesting.
Json parse_json(std::string_view text);

// Returns a value as short text for a message of one line. For null, the text says that
// there is no value.
std::string json_text(const Json& value);
std::string json_text(const Json* value);

// Shortens text to at most 60 characters, the last three of which are then dots.
std::string shortened(const std::string& text);

// Returns a string in quotation marks, in ASCII with escape sequences.
std::string in_quotes(const std::string& text);

// Returns whether UTF-8 text fits in one line of a message. It must not have control
// characters or line separators.
bool is_one_line(std::string_view text);

}  // namespace v3dg

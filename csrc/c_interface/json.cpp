// Parses JSON into a tree of values, from the events of the library nlohmann/json. The
// tree distinguishes integers from other numbers. Two errors are detected here, because
// the library accepts them: keys that occur twice, and text after a zero byte.

#include "c_interface/json.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>
#include <stdexcept>

#include "c_interface/fault.h"

namespace v3dg {

namespace {

constexpr size_t kMostDepth = 500;
constexpr size_t kMostItemsShown = 8;
constexpr size_t kMostCharactersShown = 60;
constexpr size_t kMostErrorCharacters = 120;

class Builder final : public nlohmann::json_sax<nlohmann::json> {
  public:
    bool null() override { return add({nullptr}); }
    bool boolean(bool value) override { return add({value}); }
    bool number_integer(number_integer_t value) override { return add({int64_t{value}}); }
    bool number_unsigned(number_unsigned_t value) override {
        if (value > INT64_MAX) return add({static_cast<double>(value)});
        return add({static_cast<int64_t>(value)});
    }
    bool number_float(number_float_t value, const string_t&) override { return add({value}); }
    bool string(string_t& value) override { return add({std::move(value)}); }
    bool binary(binary_t&) override { return false; }
    bool start_array(size_t) override { return open({Json::Array()}); }
    bool start_object(size_t) override { return open({Json::Object()}); }
    bool end_array() override { return close(); }
    bool end_object() override {
        check_keys(std::get<Json::Object>(open_.back()->value));
        return close();
    }
    bool key(string_t& value) override {
        std::get<Json::Object>(open_.back()->value).push_back({std::move(value), {}});
        return true;
    }
    bool parse_error(size_t, const std::string&,
                     const nlohmann::detail::exception& error) override {
        std::string text = error.what();
        text = text.substr(text.find("] ") + 2);
        text = text.substr(0, text.find("; last read"));
        throw std::invalid_argument(text.substr(0, kMostErrorCharacters));
    }

    Json take() { return std::move(root_); }

  private:
    bool add(Json value) {
        place() = std::move(value);
        return true;
    }
    bool open(Json value) {
        if (open_.size() >= kMostDepth) throw std::invalid_argument("nested too deeply");
        Json& container = place();
        container = std::move(value);
        open_.push_back(&container);
        return true;
    }
    bool close() {
        open_.pop_back();
        return true;
    }
    // Returns the location of the next value. An open container is the last element of
    // the container around it. That container does not grow while the inner one is
    // open, so pointers stay valid.
    Json& place() {
        if (open_.empty()) return root_;
        if (auto* array = std::get_if<Json::Array>(&open_.back()->value))
            return array->emplace_back();
        return std::get<Json::Object>(open_.back()->value).back().value;
    }
    static void check_keys(const Json::Object& object) {
        std::vector<const std::string*> keys;
        for (const Json::Member& member : object) keys.push_back(&member.key);
        const auto is_before = [](const std::string* a, const std::string* b) { return *a < *b; };
        std::sort(keys.begin(), keys.end(), is_before);
        const auto is_equal = [](const std::string* a, const std::string* b) { return *a == *b; };
        const auto twice = std::adjacent_find(keys.begin(), keys.end(), is_equal);
        if (twice == keys.end()) return;
        Json key;
        key.value = **twice;
        throw std::invalid_argument("the key " + json_text(key) + " occurs twice in an object");
    }

    Json root_;
    std::vector<Json*> open_;
};

std::string full_text(const Json& json);

std::string text_of_array(const Json::Array& items) {
    std::string text;
    for (const Json& item : items) text += (text.empty() ? "" : ", ") + full_text(item);
    return "[" + text + "]";
}

std::string text_of_object(const Json::Object& members) {
    std::string text;
    for (const auto& [key, value] : members)
        text += (text.empty() ? "" : ", ") + in_quotes(key) + ": " + full_text(value);
    return "{" + text + "}";
}

std::string full_text(const Json& json) {
    if (const bool* flag = json.get<bool>()) return *flag ? "true" : "false";
    if (const int64_t* number = json.get<int64_t>()) return std::to_string(*number);
    if (const double* number = json.get<double>()) return text_of(*number);
    if (const std::string* text = json.get<std::string>()) return in_quotes(*text);
    if (const Json::Array* items = json.get<Json::Array>()) return text_of_array(*items);
    if (const Json::Object* members = json.get<Json::Object>()) return text_of_object(*members);
    return "null";
}

}  // namespace

std::string in_quotes(const std::string& text) {
    return nlohmann::json(text).dump(-1, ' ', true, nlohmann::json::error_handler_t::replace);
}

std::string text_of(double number) {
    if (std::isnan(number)) return "nan";
    if (std::isinf(number)) return number < 0 ? "-inf" : "inf";
    return nlohmann::json(number).dump();
}

const Json* Json::find(std::string_view key) const {
    const Object* members = get<Object>();
    if (members == nullptr) return nullptr;
    for (const Member& member : *members)
        if (member.key == key) return &member.value;
    return nullptr;
}

Json parse_json(std::string_view text) {
    if (text.find('\0') != std::string_view::npos)
        throw std::invalid_argument("a zero byte is not JSON");
    Builder builder;
    nlohmann::json::sax_parse(text.begin(), text.end(), &builder);
    return builder.take();
}

std::string json_text(const Json& value) {
    const auto* members = value.get<Json::Object>();
    if (members != nullptr && members->size() > kMostItemsShown)
        return "an object of " + std::to_string(members->size()) + " values";
    const auto* items = value.get<Json::Array>();
    if (items != nullptr && items->size() > kMostItemsShown)
        return "an array of " + std::to_string(items->size()) + " values";
    return shortened(full_text(value));
}

std::string shortened(const std::string& text) {
    if (text.size() <= kMostCharactersShown) return text;
    return text.substr(0, kMostCharactersShown - 3) + "...";
}

std::string json_text(const Json* value) { return value == nullptr ? "null" : json_text(*value); }

bool is_one_line(std::string_view text) {
    for (size_t i = 0; i < text.size(); ++i) {
        const auto byte = static_cast<unsigned char>(text[i]);
        if (byte < 0x20 || byte == 0x7f) return false;
        const auto next = static_cast<unsigned char>(i + 1 < text.size() ? text[i + 1] : 0);
        if (byte == 0xc2 && next < 0xa0) return false;
        if (text.substr(i, 3) == "\u2028" || text.substr(i, 3) == "\u2029") return false;
    }
    return true;
}

}  // namespace v3dg

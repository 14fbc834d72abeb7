// Checks of values in a JSON file, with the error texts of the Python reader.

#include "c_interface/json_node.h"

#include <algorithm>
#include <cmath>

namespace v3dg {

namespace {

constexpr double kLargestSide = 1 << 20;  // px
constexpr size_t kMostKeyCharacters = 60;

std::string joined(const std::vector<std::string>& first, const std::vector<std::string>& second) {
    std::string text;
    for (const std::vector<std::string>& names : {first, second})
        for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
    return text;
}

bool is_in(const std::string& name, const std::vector<std::string>& names) {
    return std::find(names.begin(), names.end(), name) != names.end();
}

}  // namespace

Fault Node::problem(const std::string& text, v3dg_status status) const {
    return {status, *file_ + ": " + (path_.empty() ? "top level" : path_) + ": " + text};
}

Fault Node::error(const std::string& expected) const {
    return problem("expected " + expected + ", got " + json_text(*value_));
}

Node Node::field(const std::string& key) const {
    if (value_->get<Json::Object>() == nullptr) throw error("an object");
    const Json* member = value_->find(key);
    if (member == nullptr)
        throw problem("expected the field " + key + ", got an object without it");
    const bool is_plain = is_one_line(key) && key.size() <= kMostKeyCharacters;
    const std::string name = is_plain ? key : shortened(in_quotes(key));
    return {*member, *file_, path_.empty() ? name : path_ + "." + name};
}

Fields Node::fields(const std::vector<std::string>& required) const {
    const auto* members = value_->get<Json::Object>();
    if (members == nullptr) throw error("an object");
    Fields fields;
    for (const std::string& key : required) fields.emplace(key, field(key));
    for (const Json::Member& member : *members) fields.emplace(member.key, field(member.key));
    return fields;
}

Fields Node::only_fields(const std::vector<std::string>& required,
                         const std::vector<std::string>& optional) const {
    Fields all = fields(required);
    for (const auto& [key, node] : all)
        if (!is_in(key, required) && !is_in(key, optional))
            throw node.problem("expected one of " + joined(required, optional) +
                               ", got an unknown field");
    return all;
}

const Json::Array& Node::items(const std::string& expected) const {
    const auto* values = value_->get<Json::Array>();
    if (values == nullptr) throw error(expected);
    return *values;
}

Node Node::item(const Json::Array& values, size_t i) const {
    return {values[i], *file_, path_ + "[" + std::to_string(i) + "]"};
}

void Node::for_each(const std::function<void(const Node&)>& use) const {
    const Json::Array& values = items("an array");
    for (size_t i = 0; i < values.size(); ++i) use(item(values, i));
}

std::string Node::text() const {
    const auto* text = value_->get<std::string>();
    if (text == nullptr || text->empty()) throw error("a string");
    if (!is_one_line(*text)) throw error("a string without control characters");
    return *text;
}

double Node::number(const char* expected, double lower_bound, double upper_bound) const {
    double number = 0;
    if (const auto* whole = value_->get<int64_t>())
        number = static_cast<double>(*whole);
    else if (const auto* real = value_->get<double>())
        number = *real;
    else
        throw error("a number");
    if (!(lower_bound < number && number < upper_bound)) throw error(expected);
    return number;
}

int Node::size() const {
    const double side = number();
    if (side != std::trunc(side) || side <= 0) throw error("a positive whole number");
    if (side > kLargestSide) throw error("at most " + std::to_string(int(kLargestSide)) + " px");
    return static_cast<int>(side);
}

std::vector<double> Node::numbers() const {
    const Json::Array& values = items("an array");
    std::vector<double> numbers;
    for (size_t i = 0; i < values.size(); ++i) numbers.push_back(item(values, i).number());
    return numbers;
}

std::vector<double> Node::vector(size_t length) const {
    const std::string expected = std::to_string(length) + " numbers";
    if (items(expected).size() != length) throw error(expected);
    return numbers();
}

std::vector<double> Node::matrix(size_t num_rows, size_t num_columns) const {
    const std::string expected =
        std::to_string(num_rows) + " rows of " + std::to_string(num_columns) + " numbers";
    const Json::Array& rows = items(expected);
    if (rows.size() != num_rows) throw error(expected);
    std::vector<double> numbers;
    for (size_t i = 0; i < num_rows; ++i)
        for (const double value : item(rows, i).vector(num_columns)) numbers.push_back(value);
    return numbers;
}

}  // namespace v3dg

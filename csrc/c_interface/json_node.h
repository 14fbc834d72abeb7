#pragma once

// A JSON value that knows where it is in its file, for messages.

#include <functional>
#include <initializer_list>
#include <limits>
#include <map>
#include <string>
#include <vector>

#include "c_interface/fault.h"
#include "c_interface/json.h"

namespace v3dg {

// The fields of an object by their names.
class Node;
using Fields = std::map<std::string, Node>;

// A value, the name of its file, and its path in the document. It borrows the value and
// the name. Functions throw Fault unless the value is what they return.
class Node {
  public:
    Node(const Json& value, const std::string& file, std::string path)
        : value_(&value), file_(&file), path_(std::move(path)) {}

    const Json& value() const { return *value_; }

    // Return errors that begin with the location.
    Fault problem(const std::string& text, v3dg_status status = V3DG_ERROR_FILE) const;
    Fault error(const std::string& expected) const;
    // Returns make(). Its failures of arguments, whose messages begin with the name of
    // a field, become failures of the file, whose messages begin with the location.
    template <class Make>
    auto attempt(const Make& make) const {
        try {
            return make();
        } catch (const Fault& fault) {
            const std::string place = path_.empty() ? "" : path_ + ".";
            throw Fault(V3DG_ERROR_FILE, *file_ + ": " + place + fault.what());
        }
    }

    bool has(const std::string& key) const { return value_->find(key) != nullptr; }
    Node field(const std::string& key) const;
    // Returns the fields of an object, and throws if one of `required` is missing. For
    // only_fields(), fields other than `required` and `optional` are errors, too.
    Fields fields(const std::vector<std::string>& required) const;
    Fields only_fields(const std::vector<std::string>& required,
                       const std::vector<std::string>& optional) const;
    // Calls use(node) for every value of an array.
    void for_each(const std::function<void(const Node&)>& use) const;

    std::string text() const;
    // Returns a number strictly between two bounds.
    double number(const char* expected = "a finite number",
                  double lower_bound = -std::numeric_limits<double>::infinity(),
                  double upper_bound = std::numeric_limits<double>::infinity()) const;
    double positive() const { return number("a positive number", 0); }
    // Returns the side of a picture in px.
    int size() const;
    std::vector<double> numbers() const;
    // Return `length` numbers, and the rows of a matrix one after another.
    std::vector<double> vector(size_t length) const;
    std::vector<double> matrix(size_t num_rows, size_t num_columns) const;

  private:
    const Json::Array& items(const std::string& expected) const;
    Node item(const Json::Array& values, size_t i) const;

    const Json* value_;
    const std::string* file_;
    std::string path_;
};

}  // namespace v3dg

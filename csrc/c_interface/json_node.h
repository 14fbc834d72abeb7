#pragma once

// A JSON value together with its location in the file, for messages.

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

// A value, the name of its file, and its path in the document. The value and the name
// must outlive this object. A function throws Fault if the value is not of the kind
// that it returns.
class Node {
  public:
    Node(const Json& value, const std::string& file, std::string path)
        : value_(&value), file_(&file), path_(std::move(path)) {}

    const Json& value() const { return *value_; }

    // Return errors that begin with the location.
    Fault problem(const std::string& text, v3dg_status status = V3DG_ERROR_FILE) const;
    Fault error(const std::string& expected) const;
    // Returns make(). If it throws an error about an argument, whose message begins
    // with the name of a field, throws an error about the file instead, whose message
    // begins with the location of the value.
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
    // Returns the fields of an object. Throws if one of `required` is missing.
    // only_fields() also throws if there are fields other than `required` and
    // `optional`.
    Fields fields(const std::vector<std::string>& required) const;
    Fields only_fields(const std::vector<std::string>& required,
                       const std::vector<std::string>& optional) const;
    // Calls use(node) for each value of an array.
    void for_each(const std::function<void(const Node&)>& use) const;

    std::string text() const;
    // Returns a number strictly between two bounds.
    double number(const char* expected = "a finite number",
                  double lower_bound = -std::numeric_limits<double>::infinity(),
                  double upper_bound = std::numeric_limits<double>::infinity()) const;
    double positive() const { return number("a positive number", 0); }
    // Returns the width or height of a picture in px.
    int size() const;
    std::vector<double> numbers() const;
    // vector() returns `length` numbers; the other function returns the rows of a
    // matrix one after another.
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

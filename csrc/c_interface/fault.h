#pragma once

// The errors of the C library. Internally, they are exceptions, which v3dg.cpp converts
// to status codes.

#include <stdexcept>
#include <string>

#include <v3dg.h>

namespace v3dg {

class Fault : public std::runtime_error {
  public:
    Fault(v3dg_status status, const std::string& text) : std::runtime_error(text), status(status) {}
    const v3dg_status status;
};

// Throws unless an argument of the caller is as expected. The message is `name:
// expected ...`.
inline void check_argument(bool holds, const std::string& name, const std::string& expected) {
    if (!holds) throw Fault(V3DG_ERROR_ARGUMENT, name + ": expected " + expected);
}

// Returns a number as it appears in messages.
std::string text_of(double number);

}  // namespace v3dg

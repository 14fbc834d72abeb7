// Included before every source that zig compiles for macOS. In zig 0.17, the C++
// library includes <float.h> once only, but macOS includes it twice: whole, and for
// INFINITY and NAN alone.
#pragma once

#include <cfloat>
#include <cmath>

#ifndef INFINITY
#define INFINITY __builtin_inff()
#endif
#ifndef NAN
#define NAN __builtin_nanf("")
#endif

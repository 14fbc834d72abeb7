#include "bindings/args.h"

namespace v3dg {

void bind_fit_level(py::module_&) {}

}  // namespace v3dg

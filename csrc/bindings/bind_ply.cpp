#include "bindings/args.h"

namespace v3dg {

void bind_ply(py::module_&) {}

}  // namespace v3dg

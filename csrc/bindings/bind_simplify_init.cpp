#include "bindings/args.h"

namespace v3dg {

void bind_simplify_init(py::module_&) {}

}  // namespace v3dg

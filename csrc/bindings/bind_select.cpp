#include "bindings/args.h"

namespace v3dg {

void bind_select(py::module_&) {}

}  // namespace v3dg

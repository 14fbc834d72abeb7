// Bindings that read and write .ply files, by means of io/ply_*.h.

#include <cerrno>
#include <cmath>
#include <system_error>

#include "bindings/operations.h"
#include "bindings/types.h"
#include "io/ply.h"

namespace v3dg {

namespace {

// Returns a name as printable ASCII; other bytes become question marks.
std::string printable(std::string name) {
    for (char& c : name)
        if (c < ' ' || c > '~') c = '?';
    return name;
}

// The name of a file: in the encoding of the system, and in the form that messages
// show.
struct Path {
    explicit Path(py::object path) : shown(path) {
        PyObject* bytes = nullptr;
        if (!PyUnicode_FSConverter(path.ptr(), &bytes)) throw py::error_already_set();
        encoded = py::reinterpret_steal<py::bytes>(bytes);
    }
    py::object shown;
    py::bytes encoded;
};

// Calls body(path) without the GIL, and adds the name of the file to errors.
template <class Body>
auto with_path(const Path& path, const Body& body) {
    const char* name = PyBytes_AS_STRING(path.encoded.ptr());
    try {
        const Unlocked unlocked;
        return body(name);
    } catch (const PlyError& error) {
        const py::str message = py::str("{}: {}").format(path.shown, error.what());
        PyErr_SetObject(PyExc_ValueError, message.ptr());
        throw py::error_already_set();
    } catch (const std::system_error& error) {
        errno = error.code().value();
        PyErr_SetFromErrnoWithFilenameObject(PyExc_OSError, path.shown.ptr());
        throw py::error_already_set();
    }
}

// A .ply file that is read in runs of rows. It remembers where the last run ended.
class BoundPlyFile {
  public:
    explicit BoundPlyFile(const py::object& path)
        : path_(path), ply_(with_path(path_, open_ply)), next_(ply_.begin()) {}

    size_t num_gaussians() const { return ply_.num_gaussians(); }
    int sh_degree() const {
        return static_cast<int>(std::lround(std::sqrt(ply_.layout.num_sh))) - 1;
    }
    std::string prefix() const { return printable(ply_.layout.prefix); }
    py::list used() const {
        py::list names;
        for (const PlyField& field : ply_.layout.fields)
            if (field.property != PlyField::kNone)
                names.append(printable(ply_.vertex.properties[field.property].name));
        return names;
    }

    py::tuple read(int64_t first, int64_t last) {
        if (first < 0 || last < first || static_cast<size_t>(last) > ply_.num_gaussians())
            throw py::value_error(
                "rows: expected 0 <= first <= last <= " + std::to_string(ply_.num_gaussians()) +
                ", got " + std::to_string(first) + " to " + std::to_string(last));
        const auto n = static_cast<py::ssize_t>(last - first),
                   k = static_cast<py::ssize_t>(ply_.layout.num_sh);
        const NewArray<float> means({}, {n, 3}), quats({}, {n, 4}), scales({}, {n, 3}),
            opacities({}, {n}), sh({}, {n, k, 3});
        const PlyGaussians<float> out = {means.span, quats.span, scales.span, opacities.span,
                                         sh.span};
        // `next_` is accessed with the GIL held, so several threads may read
        // concurrently.
        const PlyPlace known = next_;
        next_ = with_path(path_, [&](const char*) {
            return read_ply(ply_, static_cast<size_t>(first), known, out);
        });
        return py::make_tuple(means.object, quats.object, scales.object, opacities.object,
                              sh.object);
    }

  private:
    Path path_;
    PlyFile ply_;
    PlyPlace next_;
};

constexpr const char* kEncodings[] = {"ascii", "binary_little_endian", "binary_big_endian"};
constexpr const char* kTypes[] = {"char",  "uchar",  "short", "ushort", "int",   "uint",
                                  "float", "double", "half",  "int64",  "uint64"};

py::tuple ply_header(const py::object& path) {
    const PlyHeader header = with_path(
        Path(path), [](const char* name) { return read_ply_header(open_ply_file(name)); });
    py::list elements;
    for (const PlyElement& element : header.elements) {
        py::list properties;
        for (const PlyProperty& property : element.properties) {
            const char* type =
                property.is_list ? "list" : kTypes[static_cast<size_t>(property.type)];
            properties.append(py::make_tuple(printable(property.name), type));
        }
        elements.append(py::make_tuple(printable(element.name), element.count, properties));
    }
    return py::make_tuple(kEncodings[static_cast<size_t>(header.encoding)], header.size, elements);
}

py::list ply_comments(const py::object& path) {
    const PlyHeader header = with_path(
        Path(path), [](const char* name) { return read_ply_header(open_ply_file(name)); });
    py::list comments;
    for (const std::string& comment : header.comments) comments.append(printable(comment));
    return comments;
}

PlyEncoding encoding_of(const std::string& name) {
    for (size_t i = 0; i < std::size(kEncodings); ++i)
        if (name == kEncodings[i]) return static_cast<PlyEncoding>(i);
    throw py::value_error(
        "encoding: expected binary_little_endian, binary_big_endian or ascii, got " +
        in_quotes(name));
}

void ply_write(const py::object& path, const py::array& means, const py::array& quats,
               const py::array& scales, const py::array& opacities, const py::array& sh,
               const std::string& encoding, const std::vector<std::string>& comments) {
    for (const std::string& comment : comments)
        if (comment.find_first_of("\r\n") != std::string::npos)
            throw py::value_error("comments: expected text without line breaks, got " +
                                  in_quotes(comment));
    const PlyEncoding chosen = encoding_of(encoding);
    const py::ssize_t n = means.ndim() > 0 ? means.shape(0) : 0;
    const py::ssize_t k = sh.ndim() > 1 ? sh.shape(1) : 0;
    if (k != 1 && k != 4 && k != 9 && k != 16)
        throw py::value_error("sh: expected shape (N, K, 3) with K = 1, 4, 9 or 16, got " +
                              shape_text(sh));
    const PlyGaussians<const float> in = {span_of<const float>(means, "means", {n, 3}),
                                          span_of<const float>(quats, "quats", {n, 4}),
                                          span_of<const float>(scales, "scales", {n, 3}),
                                          span_of<const float>(opacities, "opacities", {n}),
                                          span_of<const float>(sh, "sh", {n, k, 3})};
    with_path(Path(path), [&](const char* name) {
        write_ply(name, in, chosen, static_cast<size_t>(k), comments);
    });
}

}  // namespace

void bind_ply(py::module_& m) {
    py::class_<BoundPlyFile>(m, "PlyFile", "A .ply file of gaussians, read in runs of rows.")
        .def(py::init<const py::object&>(), "path"_a)
        .def_property_readonly("num_gaussians", &BoundPlyFile::num_gaussians)
        .def_property_readonly("sh_degree", &BoundPlyFile::sh_degree)
        .def_property_readonly("used", &BoundPlyFile::used,
                               "The names of the properties that are read.")
        .def_property_readonly("prefix", &BoundPlyFile::prefix,
                               "The prefix of property names, before those of trainers.")
        .def("read", &BoundPlyFile::read, "first"_a, "last"_a);
    m.def("ply_header", &ply_header, "path"_a,
          "Returns the encoding, the bytes of the header, and the elements: their names, counts,"
          " and the names and types of their properties.");
    m.def("ply_comments", &ply_comments, "path"_a, "Returns the comments of the header, in order.");
    m.def("ply_write", ply_write, "path"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a,
          "encoding"_a, "comments"_a = std::vector<std::string>());
}

}  // namespace v3dg

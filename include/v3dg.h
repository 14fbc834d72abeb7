/* v3dg: level of detail for 3D Gaussian Splatting, as a C library.
 *
 * Open a bundle (.v3dg) or a scene (.json), choose the clusters that a camera needs, and
 * read the pages that contain their gaussians. The library draws nothing. It needs no GPU
 * and no Python. docs/c_interface.md describes its use.
 *
 * Errors: a function that can fail returns a v3dg_status. After a failure,
 * v3dg_last_error() returns a sentence about it, and nothing was written to the results.
 * No C++ exception leaves the library. Invalid files, including malicious ones, are
 * errors.
 *
 * Threads: several threads may call functions that take a const v3dg_scene with the same
 * scene at the same time. A function that takes a v3dg_scene without const needs exclusive
 * access to it. Different scenes are independent. A cut is constant and remains valid when
 * its scene changes. Selection and reading use OpenMP threads; OMP_NUM_THREADS sets their
 * number.
 *
 * Coordinates: matrices are row-major. Cameras follow the OpenCV convention, with x to the
 * right, y down and z forward. Quaternions are w, x, y, z.
 *
 * Versions: V3DG_ABI_VERSION is the number in the library's file name. It rises when a
 * function or a struct changes; new functions do not raise it. */

#ifndef V3DG_H
#define V3DG_H

#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32) && defined(V3DG_BUILDS_LIBRARY)
#define V3DG_API __declspec(dllexport)
#elif defined(_WIN32)
#define V3DG_API __declspec(dllimport)
#elif defined(V3DG_BUILDS_LIBRARY)
#define V3DG_API __attribute__((visibility("default")))
#else
#define V3DG_API
#endif

#define V3DG_ABI_VERSION 0

#ifdef __cplusplus
extern "C" {
#endif

typedef enum v3dg_status {
    V3DG_OK = 0,
    V3DG_ERROR_ARGUMENT = 1, /* an argument has a value that is not allowed */
    V3DG_ERROR_FILE = 2,     /* the content of a file is wrong, damaged or too new */
    V3DG_ERROR_SYSTEM = 3,   /* the system cannot open or read a file */
    V3DG_ERROR_BUDGET = 4,   /* even the coarsest cut exceeds the budget */
    V3DG_ERROR_MEMORY = 5,   /* there is not enough memory */
    V3DG_ERROR_INTERNAL = 6  /* anything else */
} v3dg_status;

/* Bundles and their instances. */
typedef struct v3dg_scene v3dg_scene;

typedef struct v3dg_scene_info {
    uint64_t num_instances;
    uint32_t num_bundles;
    uint32_t num_cameras; /* of the scene's file */
} v3dg_scene_info;

typedef struct v3dg_bundle_info {
    uint64_t num_gaussians;   /* of all levels together */
    uint64_t num_page_bytes;  /* of all pages together */
    uint64_t most_page_bytes; /* of the largest page */
    uint32_t num_clusters;
    uint32_t num_groups;
    uint32_t num_pages;
    uint32_t num_levels;
    int32_t sh_degree;    /* 0 to 3 */
    int32_t is_quantized; /* 1: pages contain codes; 0: float32 numbers */
    int32_t version;      /* of the file's format */
} v3dg_bundle_info;

/* A page contains the clusters that one group replaces. They are stored and read together. */
typedef struct v3dg_page_info {
    uint64_t offset;         /* of the first byte in the bundle's file */
    uint64_t num_bytes;      /* in the file, including padding */
    uint64_t first_gaussian; /* index in the bundle */
    uint64_t num_gaussians;
    uint32_t first_cluster;
    uint32_t num_clusters;
    int32_t parent; /* page above, which must be resident if this page is; -1: none */
    int32_t level;  /* of its clusters; 0 is the finest */
} v3dg_page_info;

/* An instance transforms a point p of its bundle to scale * rotation p + position. */
typedef struct v3dg_instance {
    double position[3];
    double quaternion[4]; /* any length but zero */
    double scale;         /* positive */
    uint32_t bundle;      /* index in the scene */
    int32_t environment;  /* carried from files; -1: all. A cut contains every instance */
    float importance;     /* positive: it is selected as if the tolerance were divided by this */
    float opacity;        /* 0 to 1, factor of opacities; with 0 the instance is left out */
    float tint[3];        /* factors of red, green and blue, at least 0 */
} v3dg_instance;

/* One instance of the first bundle at the origin, as an initialiser. */
#define V3DG_DEFAULT_INSTANCE {{0, 0, 0}, {1, 0, 0, 0}, 1, 0, -1, 1, 1, {1, 1, 1}}

typedef enum v3dg_lens {
    V3DG_PINHOLE = 0,
    V3DG_OPENCV = 1, /* k1, k2, p1, p2, k3 to k6 */
    V3DG_FISHEYE = 2 /* k1 to k4 of OpenCV's fisheye model */
} v3dg_lens;

typedef struct v3dg_camera {
    double viewmat[16];   /* world to camera: a rotation and a translation */
    double fx, fy;        /* focal lengths, px */
    double cx, cy;        /* principal point, px */
    double near_depth;    /* smallest depth that is drawn, world units, positive */
    double distortion[8]; /* coefficients of the lens; those without a meaning are 0 */
    int32_t width;        /* px, 1 to 65535 */
    int32_t height;
    int32_t lens; /* a v3dg_lens */
} v3dg_camera;

#define V3DG_NO_BUDGET UINT64_MAX

/* The rule by which a cut is chosen. NULL means V3DG_DEFAULT_RULE. */
typedef struct v3dg_rule {
    /* Largest screen area, in px² per gaussian, at which a coarser cluster replaces finer
     * ones. At least 0. */
    double tolerance_px2;
    /* Clusters within this factor of the tolerance are drawn on two or more levels, whose
     * weights add up to 1, so that nothing pops while the camera moves. 1 (no fade) to 1000;
     * 1.02 suits sequences of pictures. */
    double fade;
    /* Largest number of gaussians, or V3DG_NO_BUDGET. The tolerance is raised until the cut
     * has no more. It begins at tolerance_px2, which is usually 0 with a budget. */
    uint64_t budget;
    int32_t min_level; /* finer levels are not chosen */
    int32_t culls;     /* 1: leave out clusters outside of the picture */
} v3dg_rule;

#define V3DG_DEFAULT_RULE {3.0, 1.0, V3DG_NO_BUDGET, 0, 1}

/* A cluster of an instance that a cut contains. */
typedef struct v3dg_pair {
    int32_t instance;
    int32_t cluster;        /* of the instance's bundle */
    uint32_t page;          /* that contains the cluster */
    uint32_t first_in_page; /* index of the cluster's first gaussian in the page */
    uint32_t num_gaussians;
    float weight;           /* factor of opacities, 0 to 1; 1 without a fade */
    float filter_px2;       /* variance of the low-pass on the screen, px² */
    int32_t is_antialiased; /* 1: opacities are compensated for the filter */
} v3dg_pair;

/* A page that is not resident and that a cut needs, or will need soon. */
typedef struct v3dg_missing_page {
    uint32_t bundle;
    uint32_t page;
    float priority; /* above 1: the cut is coarser without it; else it is needed soon */
} v3dg_missing_page;

typedef struct v3dg_cut {
    const v3dg_pair* pairs; /* ordered by instance, then by cluster */
    uint64_t num_pairs;
    uint64_t num_gaussians; /* of all pairs together */
    /* The most urgent pages come first, and each page comes after the pages above it. */
    const v3dg_missing_page* missing;
    uint64_t num_missing;
    uint64_t revision;   /* of the scene's instances when the cut was selected */
    float tolerance_px2; /* of this cut; with a budget, the one that meets it */
} v3dg_cut;

/* Memory of the caller that receives gaussians. An array that is NULL is not written. */
typedef struct v3dg_gaussians {
    float* means;       /* 3 each */
    float* quaternions; /* 4 each */
    float* scales;      /* 3 each: standard deviations along the axes */
    float* opacities;   /* 1 each, 0 to 1 */
    /* 3 (sh_degree + 1)² each: coefficients of spherical harmonics, each red, green, blue.
     * The colour of degree 0 is 0.28209479 times the first coefficient plus 0.5. */
    float* sh;
    uint64_t capacity; /* number of gaussians that each array has room for */
    /* 0 to 3. Coefficients of higher degrees are left out, and absent ones are 0. */
    int32_t sh_degree;
} v3dg_gaussians;

/* Return the V3DG_ABI_VERSION of the library. */
V3DG_API uint32_t v3dg_abi_version(void);

/* Return a sentence about the last failure in this thread, in UTF-8 as far as the names of
 * files are. It is valid until the next call of a function of this library in this thread. */
V3DG_API const char* v3dg_last_error(void);

/* Open a bundle or a scene's file (docs/scene.md) with its bundles. A bundle becomes a scene
 * with one instance at the origin. Tables are read and verified at once, and pages when they
 * are used. Files stay open until v3dg_close(), so replacing them has no effect. */
V3DG_API v3dg_status v3dg_open(const char* path, v3dg_scene** scene);

/* Open another bundle, without an instance. `bundle` receives its index. */
V3DG_API v3dg_status v3dg_add_bundle(v3dg_scene* scene, const char* path, uint32_t* bundle);

/* Free a scene. NULL is allowed. */
V3DG_API void v3dg_close(v3dg_scene* scene);

V3DG_API v3dg_status v3dg_get_scene_info(const v3dg_scene* scene, v3dg_scene_info* info);
V3DG_API v3dg_status v3dg_get_bundle_info(const v3dg_scene* scene, uint32_t bundle,
                                          v3dg_bundle_info* info);
V3DG_API v3dg_status v3dg_get_page_info(const v3dg_scene* scene, uint32_t bundle, uint32_t page,
                                        v3dg_page_info* info);

/* Return a camera of the scene's file. `name`, which may be NULL, receives its name, which
 * is valid as long as the scene. */
V3DG_API v3dg_status v3dg_get_camera(const v3dg_scene* scene, uint32_t index, v3dg_camera* camera,
                                     const char** name);

/* Write a camera at `eye` that has `target` at the picture's centre and `up` upwards.
 * `fov_x` is the horizontal field of view in radians. */
V3DG_API v3dg_status v3dg_look_at(const double eye[3], const double target[3], const double up[3],
                                  double fov_x, int32_t width, int32_t height, double near_depth,
                                  v3dg_camera* camera);

/* Copy all instances to an array with room for `capacity` of them. */
V3DG_API v3dg_status v3dg_get_instances(const v3dg_scene* scene, v3dg_instance* instances,
                                        uint64_t capacity);

/* Replace all instances. */
V3DG_API v3dg_status v3dg_set_instances(v3dg_scene* scene, const v3dg_instance* instances,
                                        uint64_t num_instances);

/* Set which pages of a bundle are in the caller's memory: one value for each page, nonzero
 * if it is. Cuts then contain only clusters of these pages, and list the missing pages. The
 * last page must be resident, and so must the pages above each resident page. NULL means
 * that all pages are resident, as after opening. */
V3DG_API v3dg_status v3dg_set_resident(v3dg_scene* scene, uint32_t bundle,
                                       const uint8_t* is_resident, uint32_t num_pages);

/* Choose the clusters that are just detailed enough for a camera, or for the two eyes of a
 * stereo camera (num_eyes 2), which must be pinholes with equal rotations. On every path
 * from a leaf of an instance to its root, the weights of the chosen clusters add up to 1.
 * The cut is that of v3dg.select in Python, on every machine. `rule` may be NULL. */
V3DG_API v3dg_status v3dg_select(const v3dg_scene* scene, const v3dg_camera* eyes,
                                 uint32_t num_eyes, const v3dg_rule* rule, v3dg_cut** cut);

/* Free a cut. NULL is allowed. */
V3DG_API void v3dg_free_cut(v3dg_cut* cut);

/* Read the bytes of a page (docs/format.md) and verify their hash. */
V3DG_API v3dg_status v3dg_read_page(const v3dg_scene* scene, uint32_t bundle, uint32_t page,
                                    void* bytes, uint64_t capacity);

/* Read, verify and decode the gaussians of a page, in the coordinates of its bundle. */
V3DG_API v3dg_status v3dg_read_gaussians(const v3dg_scene* scene, uint32_t bundle, uint32_t page,
                                         const v3dg_gaussians* gaussians);

/* Read all gaussians of a cut in world coordinates, in the order of its pairs. Weights and
 * factors of instances are part of opacities and colours. `origin`, which may be NULL, is
 * subtracted from all means: coordinates that are large for float32 stay precise if it is
 * the camera's position. The instances must be those of the selection. */
V3DG_API v3dg_status v3dg_read_cut(const v3dg_scene* scene, const v3dg_cut* cut,
                                   const double origin[3], const v3dg_gaussians* gaussians);

#ifdef __cplusplus
}
#endif

#endif

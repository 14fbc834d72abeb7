#pragma once

// Annotations for Clang's thread-safety analysis. They tell which mutex guards a field,
// and which mutex a function needs.
//
// Clang checks them with -Wthread-safety (.ci/check_threads.py). For other compilers,
// they are empty. base/mutex.h has the annotated types.

#if defined(__clang__)
#define V3DG_THREAD_ATTRIBUTE(...) __attribute__((__VA_ARGS__))
#else
#define V3DG_THREAD_ATTRIBUTE(...)
#endif

// Mark a type as a capability, such as a mutex, or as a scope that holds one.
#define V3DG_CAPABILITY(name) V3DG_THREAD_ATTRIBUTE(capability(name))
#define V3DG_SCOPED_CAPABILITY V3DG_THREAD_ATTRIBUTE(scoped_lockable)

// Marks a variable that is accessed only while the mutex is held.
#define V3DG_GUARDED_BY(mutex) V3DG_THREAD_ATTRIBUTE(guarded_by(mutex))

// Mark a function whose caller must hold the mutex, or must not hold it.
#define V3DG_REQUIRES(...) V3DG_THREAD_ATTRIBUTE(requires_capability(__VA_ARGS__))
#define V3DG_EXCLUDES(...) V3DG_THREAD_ATTRIBUTE(locks_excluded(__VA_ARGS__))

// Mark a function that locks the mutex, that unlocks it, or that locks it if it returns
// `success`.
#define V3DG_ACQUIRE(...) V3DG_THREAD_ATTRIBUTE(acquire_capability(__VA_ARGS__))
#define V3DG_RELEASE(...) V3DG_THREAD_ATTRIBUTE(release_capability(__VA_ARGS__))
#define V3DG_TRY_ACQUIRE(success, ...) \
    V3DG_THREAD_ATTRIBUTE(try_acquire_capability(success, ##__VA_ARGS__))

#pragma once

// Annotations that state which fields a mutex guards and which functions need it.
//
// Clang checks these attributes with -Wthread-safety (.ci/check_threads.py runs it);
// for other compilers they are empty. They apply to the types in base/mutex.h.

#if defined(__clang__)
#define V3DG_THREAD_ATTRIBUTE(...) __attribute__((__VA_ARGS__))
#else
#define V3DG_THREAD_ATTRIBUTE(...)
#endif

// Marks a type as a capability, such as a mutex, and a type that holds one from its
// construction to its destruction.
#define V3DG_CAPABILITY(name) V3DG_THREAD_ATTRIBUTE(capability(name))
#define V3DG_SCOPED_CAPABILITY V3DG_THREAD_ATTRIBUTE(scoped_lockable)

// Marks a variable that is read and written only while the mutex is held.
#define V3DG_GUARDED_BY(mutex) V3DG_THREAD_ATTRIBUTE(guarded_by(mutex))

// Mark a function whose caller must hold the mutex, or must not hold it.
#define V3DG_REQUIRES(...) V3DG_THREAD_ATTRIBUTE(requires_capability(__VA_ARGS__))
#define V3DG_EXCLUDES(...) V3DG_THREAD_ATTRIBUTE(locks_excluded(__VA_ARGS__))

// Mark a function that acquires or releases the mutex, or acquires it if it returns
// `success`.
#define V3DG_ACQUIRE(...) V3DG_THREAD_ATTRIBUTE(acquire_capability(__VA_ARGS__))
#define V3DG_RELEASE(...) V3DG_THREAD_ATTRIBUTE(release_capability(__VA_ARGS__))
#define V3DG_TRY_ACQUIRE(success, ...) \
    V3DG_THREAD_ATTRIBUTE(try_acquire_capability(success, ##__VA_ARGS__))

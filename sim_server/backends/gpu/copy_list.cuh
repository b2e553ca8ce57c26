// SPDX-License-Identifier: MIT
// Copies that the device makes in one launch (copy_list.cu), within its memory or from page-locked memory of the host.
#pragma once

struct DeviceCopy {
    char* target;
    const char* source;
    long long bytes;
};

struct CopyList {                     // its memory is page-locked: the host says what is to be copied
    const DeviceCopy* copies;
    const long long* count;
};

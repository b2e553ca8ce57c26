// SPDX-License-Identifier: MIT
// Copies that the device makes in one launch (copy_list.cu), within its memory or out of the list.
#pragma once

struct DeviceCopy {
    char* target;
    const char* source;
    long long bytes;
};

struct CopyList {     // beginning of a list
    long long count;
    long long first;  // byte of the list at which the first copy stands; contents to be copied may come before it
};
